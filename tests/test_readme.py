"""What the README prints is true: its floors, its commands, its code and its links."""

from __future__ import annotations

import dataclasses
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from dtmpc_drake.__main__ import app
from dtmpc_drake.experiments.simulate import OUTPUTS, run
from dtmpc_drake.planning import plan
from dtmpc_drake.scenario import Costs, Limits, parse_scenario

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CHEAP = (
    "activate",
    "dtmpc list",
    "dtmpc show",
    "dtmpc check",
    "dtmpc simulate",
    "dtmpc export",
)


def scenarios() -> dict[str, str]:
    """The blocks that are whole scenario files, by their name."""
    texts = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    return {t.split()[1]: t for t in texts if t.startswith("name: ")}


def floors() -> list[str]:
    """The words of the import contract, from the highest floor to the lowest."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    (layers,) = [c["layers"] for c in contracts if c["name"] == "the floors"]
    return [word for layer in layers for word in re.findall(r"\w+", layer)]


def block(title: str, language: str) -> str:
    """The first block of code of a language in a section."""
    section = README.split(f"\n## {title}\n")[1].split("\n## ")[0]
    return section.split(f"```{language}\n")[1].split("```")[0]


def test_the_floors_are_the_words_of_the_contract() -> None:
    told = README.split("Imports run one way, down these floors:")[1].split(". ")[0]
    assert re.findall(r"`(\w+)`", told) == floors()


def test_the_drawing_of_the_house_has_the_rooms_in_their_order() -> None:
    drawn = re.findall(
        r"^  (\w+)/ ", block("How the house is laid out", ""), re.MULTILINE
    )
    assert drawn == [w for w in floors() if (ROOT / "dtmpc_drake" / w).is_dir()]


def test_the_commands_work_as_printed(tmp_path: Path) -> None:
    """The cheap ones, one after the other, where `make` has made its environment."""
    if not (Path(sys.prefix) / "bin" / "dtmpc").exists():
        pytest.skip("the package is not installed in this environment")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    lines = block("From the command line", "sh").splitlines()
    cheap = [line for line in lines if any(word in line for word in CHEAP)]
    assert len(cheap) == len(CHEAP) < len(lines)
    process = subprocess.run(
        ["bash", "-e"],
        input="\n".join(cheap),
        cwd=tmp_path,
        env=os.environ | {"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    assert "known_environment" in process.stdout
    assert "valid: Scenario(" in process.stdout
    assert (tmp_path / "results" / "summary.json").exists()
    assert (tmp_path / "mine.csv").read_text(encoding="utf-8").startswith("duration,")


def test_every_command_printed_is_one_of_ours() -> None:
    printed = re.findall(r"\bdtmpc ([a-z][a-z-]+)", README)
    assert len(printed) >= 7
    assert set(printed) <= set(typer.main.get_command(app).commands)
    assert "python -m diagrams" not in README


def test_the_code_runs_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(block("From Python", "python"), names)
    assert names["result"].certified  # type: ignore[attr-defined]
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", scenarios())
def test_the_scenarios_work_as_printed(name: str, tmp_path: Path) -> None:
    """Planned, certified, flown, drawn and written."""
    experiment = run(parse_scenario(scenarios()[name]), tmp_path)
    assert experiment.safe, experiment
    assert {path.name for path in experiment.files} == set(OUTPUTS)
    unit = "mm" if name == "table_top" else "m"
    assert experiment.summary()["units"]["length"] == unit


def test_what_the_scenarios_are_said_to_be() -> None:
    assert set(scenarios()) == {"fenced_yard", "table_top", "descent_step"}
    yard = plan(parse_scenario(scenarios()["fenced_yard"]))
    assert yard.plan is not None and yard.certificate is not None
    bandwidth = yard.plan.bandwidth(yard.plan.sample_times())
    assert bandwidth.min() == pytest.approx(1.0, abs=0.01)
    assert bandwidth.max() == pytest.approx(1.36, abs=0.02)
    assert 0 <= yard.certificate.margins["position"].value < 0.005
    leg = plan(parse_scenario(scenarios()["descent_step"])).plan
    assert leg is not None
    widest = 2 * leg.position_tube(leg.sample_times()).max()
    assert widest == pytest.approx(59, abs=1)


def test_the_costs_are_as_printed() -> None:
    text = block("Costs", "yaml")
    scenario = parse_scenario(f"{text}start: {{position: [0, 0, 1]}}\nduration: 14\n")
    assert scenario.goal.soft is True
    assert scenario.cost.input == [2.0, 2.0, 4.0]


def test_the_tables_have_every_field_of_limits_and_costs() -> None:
    for title, section in (("Limits", Limits), ("Costs", Costs)):
        text = README.split(f"\n## {title}\n")[1].split("\n## ")[0]
        rows = re.findall(r"^\| `(\w+): ", text, re.MULTILINE)
        assert rows == [field.name for field in dataclasses.fields(section)]


def test_links_to_files_lead_somewhere() -> None:
    targets = re.findall(r"\]\((?!http)([^)#]+)\)", README)
    assert len(targets) > 10
    assert [target for target in targets if not (ROOT / target).exists()] == []
