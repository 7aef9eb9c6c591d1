"""The house stands: no import upward, scikit-learn only where estimators live."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import lpvlearn

ROOT = Path(lpvlearn.__file__).parent

# From the ground up: a room (a package, or a file at the top) imports from the floors
# below its own only.
FLOORS = (
    ("exceptions", "minimax", "systems", "validation"),
    ("data", "models"),
    ("metrics", "structures", "subspace"),
    ("datasets", "inspection", "lpv", "restructuring"),
    ("pipeline",),
    ("__init__",),
    ("command", "paper"),
    ("__main__",),
)

# The same within the two largest rooms.
FLOORS_OF_PIPELINE = (
    ("checks", "running", "steps"),
    ("points", "scheduled"),
    ("one_basis",),
    ("refining",),
    ("output_error", "reports"),
    ("estimator",),
    ("model_files", "suggestion"),
    ("__init__",),
)
FLOORS_OF_SUBSPACE = (
    ("samples", "telling"),
    ("simulation_error",),
    ("evidence", "missing_outputs"),
    ("orders",),
    ("closed_loop",),
    ("fits",),
    ("alternatives", "completion"),
    ("diagnosis",),
    ("fit",),
    ("streams",),
    ("estimator",),
    ("__init__",),
)

# Whatever speaks scikit-learn's language; the mathematics does without.
SPEAKS_SKLEARN = (
    "data/*",
    "*/estimator.py",
    "lpv/interpolator.py",
    "metrics/*",
    "pipeline/*",
    "pipeline/*/*",
    "restructuring/fit_warnings.py",
    "inspection/parameters.py",
    "datasets/*",
    "paper/*",
)

FILES = sorted(ROOT.rglob("*.py"))
HOUSES = (
    (ROOT, FLOORS),
    (ROOT / "pipeline", FLOORS_OF_PIPELINE),
    (ROOT / "subspace", FLOORS_OF_SUBSPACE),
)


def files_of(house: Path) -> list[Path]:
    return [path for path in FILES if path.is_relative_to(house)]


def room_of(path: Path, house: Path = ROOT) -> str:
    """The package of a file in a house, or the file itself at its top."""
    parts = path.relative_to(house).parts
    return parts[0] if len(parts) > 1 else path.stem


def imports_of(path: Path):
    """Import statements of a file, those within functions too."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [n for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom)]


def imported_rooms(path: Path, house: Path = ROOT) -> set[str]:
    """Rooms of a house that a file of it imports, its own left out."""
    depth = len(path.relative_to(house).parts) - 1
    rooms = set()
    for node in imports_of(path):
        if isinstance(node, ast.ImportFrom) and node.level == depth + 1:
            if node.module is not None:
                rooms.add(node.module.split(".")[0])
                continue
            for name in node.names:  # from .. import X: a room, or the public face
                room = house / name.name
                is_room = room.is_dir() or room.with_suffix(".py").is_file()
                rooms.add(name.name if is_room else "__init__")
    return rooms - {room_of(path, house)}


def arrows(house: Path = ROOT) -> set[tuple[str, str]]:
    return {
        (room_of(path, house), room)
        for path in files_of(house)
        for room in imported_rooms(path, house)
    }


def test_rooms_are_entered_when_they_are_asked_for():
    script = """if True:
        import sys, lpvlearn
        assert "numpy" not in sys.modules and {*lpvlearn.__all__} <= {*dir(lpvlearn)}
        from lpvlearn import StateSpace
        assert "sklearn" not in sys.modules and lpvlearn.systems and StateSpace
        assert lpvlearn.StateSpace is StateSpace and not hasattr(lpvlearn, "nothing")
    """
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT.parent)


@pytest.mark.parametrize(("house", "floors"), HOUSES)
def test_every_room_has_a_floor(house, floors):
    placed = [room for floor in floors for room in floor]
    rooms = {room_of(path, house) for path in files_of(house)}
    assert sorted(placed) == sorted(rooms)


@pytest.mark.parametrize(("house", "floors"), HOUSES)
def test_no_import_runs_upward(house, floors):
    floor = {room: i for i, rooms in enumerate(floors) for room in rooms}
    upward = [pair for pair in arrows(house) if floor[pair[0]] <= floor[pair[1]]]
    assert sorted(upward) == []


def test_the_house_is_small_enough_to_be_seen_at_once():
    assert sum(len(rooms) for rooms in FLOORS) <= 20
    assert len(FLOORS) <= 9
    assert len(arrows()) <= 61


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_are_relative_and_rooms_bear_plain_names(path):
    for node in imports_of(path):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names]
        level = getattr(node, "level", 0)
        assert level or not any(name.split(".")[0] == "lpvlearn" for name in names)
    assert path.stem.startswith("__") or not path.stem.startswith("_")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_scikit_learn_stays_with_the_estimators(path):
    speaks = any(path.relative_to(ROOT).match(pattern) for pattern in SPEAKS_SKLEARN)
    modules = {getattr(node, "module", None) or "" for node in imports_of(path)}
    modules |= {a.name for node in imports_of(path) for a in node.names}
    assert speaks or not any(name.split(".")[0] == "sklearn" for name in modules)


def test_packages_hand_on_what_they_list():
    for package in (p for p in ROOT.iterdir() if (p / "__init__.py").is_file()):
        tree = ast.parse((package / "__init__.py").read_text(encoding="utf-8"))
        handed = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        listed = [
            ast.literal_eval(node.value)
            for node in tree.body
            if isinstance(node, ast.Assign) and node.targets[0].id == "__all__"
        ]
        assert handed == set(listed[0] if listed else ()), package.name


BENCHMARKS = sorted((Path(__file__).parent / "benchmarks").glob("*.py"))


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda p: p.name)
def test_benchmarks_import_what_is_there(path):
    """They need peers that no test has, and are run by hand."""
    for node in imports_of(path):
        module = getattr(node, "module", None) or ""
        if module.split(".")[0] == "lpvlearn":
            room = importlib.import_module(module)
            for name in (alias.name for alias in node.names):
                if not hasattr(room, name):
                    importlib.import_module(f"{module}.{name}")
