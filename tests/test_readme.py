"""What the README shows is what a reader gets."""

import contextlib
import importlib.util
import io
import re
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language, number=0):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.S)[number]


def test_example_prints_what_the_readme_shows(monkeypatch):
    monkeypatch.chdir(ROOT)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(block("python"), "README.md", "exec"), {})
    shown = [line.rstrip() for line in block("text").strip("\n").splitlines()]
    assert [line.rstrip() for line in printed.getvalue().splitlines()] == shown


@pytest.mark.parametrize("marker", ["run", "test"])
def test_commands_stand_behind_their_markers(marker):
    commands = re.findall(rf"<!-- {marker} -->\n```bash\n(.*?)```", README, flags=re.S)
    assert len(commands) == 1
    assert commands[0].startswith("python3 -m venv .venv && ")


def test_small_tables_follow_from_their_seeds():
    path = ROOT / "datasets" / "regenerate.py"
    spec = importlib.util.spec_from_file_location("regenerate", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    crane, hoisting = module.crane_tables()
    for name, table, atol in (
        ("varying_spring", module.spring_table(), 1.5e-5),
        ("gantry_crane", crane, 1.5e-6),
        ("gantry_crane_hoisting", hoisting, 1.5e-6),
    ):
        stored = pd.read_csv(ROOT / "datasets" / f"{name}.csv")
        pd.testing.assert_frame_equal(table, stored, atol=atol)
