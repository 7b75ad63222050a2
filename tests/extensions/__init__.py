"""A user's own package: things that the library does not have, one a file.

Importing it registers them, and so does ``--plugin tests/extensions/__init__.py``.
"""

from . import cost, disturbance, limit, model, obstacle

__all__ = ["cost", "disturbance", "limit", "model", "obstacle"]
