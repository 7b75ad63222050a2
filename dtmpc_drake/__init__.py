"""Dynamic Tube MPC for nonlinear systems, as Drake systems.

Import from the modules: `scenario` (experiments), `planning` (plans), `systems`
(Drake LeafSystems), `visualization` (figures and replays).
"""
