"""What is left when work is killed, or cannot write: nothing half done or lost."""

import contextlib
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
from joblib import delayed

from lpvlearn.__main__ import main
from lpvlearn.pipeline.running.workers import results_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self").exists(), reason="reads /proc"),
]

SHARED = Path("/dev/shm")
PATIENCE = 60  # seconds for what takes a few: the machine may be busy

PAPER = [sys.executable, "-m", "lpvlearn", "--realizations", "1", "--jobs", "2"]

FIT = """
import sys
from sklearn.model_selection import GridSearchCV
from lpvlearn import GrayBoxRestructurer, LocalLPVPipeline, SubspaceLTI
from tests.conftest import spring_structure, spring_tables

if __name__ == "__main__":
    X, y = spring_tables(n_samples={size})
    model = LocalLPVPipeline(
        SubspaceLTI(), GrayBoxRestructurer(spring_structure()), inputs="force",
        scheduling="kappa", experiment="run", time="time", **{options})
    print("begun", flush=True)
    {fit}
    print(model.parameters_.to_json(double_precision=15))
"""
ALONE = "model.fit(X, y)"
SEARCH = """
    folds = [(X.index, X.index)]
    search = GridSearchCV(model, {'local__order': [2] * 8}, cv=folds, n_jobs=2)
    model = search.fit(X, y).best_estimator_
"""


def begun(command, preexec_fn=None, **options):
    """A process in a session of its own, which Ctrl-C ends even in the background.

    `there` is the shared memory that others left before it, of the same number maybe.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}

    def before():  # shells have what they run in the background ignore it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if preexec_fn is not None:
            preexec_fn()

    there = set(SHARED.glob("*"))
    process = subprocess.Popen(
        command, start_new_session=True, preexec_fn=before, **pipes, **options
    )
    process.there = there
    return process


def script(fit=ALONE, size=4000, **options):
    text = FIT.replace("{options}", repr(options)).replace("{fit}", fit)
    text = text.replace("{size}", str(size))
    return [sys.executable, "-c", text]


def session(process):
    """Processes alive in the session of a process, itself left out."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            pid = int(stat.parent.name)
            if int(fields[3]) == process.pid != pid and fields[0] != "Z":
                found.append(pid)
    return found


def workers(process):
    """Those in the session that run the code of Loky."""
    found = []
    for pid in session(process):
        with contextlib.suppress(OSError):
            if b"LokyProcess" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def until(true, what):
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def wait_for_points(folder, n_points=1):
    """Until so many points are in the folder of those done."""
    until(lambda: len(list(folder.rglob("output.pkl"))) >= n_points, "no point is done")


def written(folder):
    return {f: f.stat().st_mtime_ns for f in folder.rglob("output.pkl")}


def nothing_left(process):
    until(lambda: not session(process), "processes are left")
    own = re.compile(rf"[-_]{process.pid}[-_]")
    until(
        lambda: not any(map(own.search, map(str, {*SHARED.glob("*")} - process.there))),
        "shared memory is left",
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The tables of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole")
    subprocess.run([*PAPER, "--output", folder / "results"], check=True, text=True)
    assert [f.name for f in folder.iterdir()] == ["results"]
    return tables(folder / "results")


def tables(folder):
    names = {f.name for f in folder.glob("*.csv")} - {"timing.csv"}
    return {name: (folder / name).read_bytes() for name in names}


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_an_ended_command_leaves_points_to_go_on_with(name, tmp_path, whole):
    output, done = tmp_path / "results", tmp_path / ".results.done"
    process = begun([*PAPER, "--output", output])
    wait_for_points(done, 2)
    process.send_signal(getattr(signal, name))
    _, told = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + getattr(signal, name)
    assert "--resume" in told and "Traceback" not in told
    nothing_left(process)
    assert [f.name for f in tmp_path.iterdir()] == [done.name]
    if name != "SIGTERM":
        return  # the rest is the same
    before = written(done)
    process = begun([*PAPER, "--output", output, "--resume"])
    wait_for_points(done, len(before) + 1)
    assert before.items() <= written(done).items()
    _, told = process.communicate(timeout=5 * PATIENCE)
    assert process.returncode == 0, told
    assert tables(output) == whole
    assert not done.exists()


@pytest.mark.parametrize(
    "fit, number",
    [
        (ALONE, signal.SIGTERM),
        (ALONE, signal.SIGKILL),
        (SEARCH, signal.SIGHUP),
        (SEARCH, signal.SIGKILL),
    ],
)
def test_workers_end_with_the_process_that_started_them(fit, number, tmp_path):
    jobs = 2 if fit == ALONE else None
    process = begun(script(fit, n_jobs=jobs, memory=str(tmp_path)))
    wait_for_points(tmp_path)
    process.send_signal(number)
    process.communicate(timeout=PATIENCE)
    nothing_left(process)


@pytest.mark.parametrize(
    "fit, number, later",
    [
        (ALONE, signal.SIGHUP, 0.0),
        (ALONE, signal.SIGKILL, 0.5),  # while they import, or the first has half a task
        (SEARCH, signal.SIGKILL, 0.5),
    ],
)
def test_workers_that_only_begin_end_as_well(fit, number, later):
    """Half of their first task is sent then: it is too large to be sent at once."""
    process = begun(script(fit, size=20_000, n_jobs=2 if fit == ALONE else None))
    until(lambda: len(workers(process)) == 2, "no workers")
    time.sleep(later)
    process.send_signal(number)
    process.communicate(timeout=PATIENCE)
    nothing_left(process)


def test_a_killed_worker_is_told(tmp_path):
    process = begun(script(n_jobs=2, memory=str(tmp_path)))
    wait_for_points(tmp_path)
    os.kill(workers(process)[0], signal.SIGKILL)
    _, told = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "RuntimeError: A worker process was killed" in told
    nothing_left(process)


def half_a_result():
    """End this process while it sends its result."""

    def send(connection, data):
        os.write(connection.fileno(), data[: len(data) // 2])
        os.kill(os.getpid(), signal.SIGKILL)

    Connection._send = send
    return bytes(10**5)


def test_a_worker_killed_in_the_middle_of_its_result_is_told():
    tasks = [delayed(half_a_result)(), delayed(time.sleep)(0)]
    with pytest.raises(RuntimeError, match="A worker process was killed"):
        list(results_of(tasks, n_jobs=2))


def test_a_module_that_workers_do_not_find_is_named(tmp_path, monkeypatch):
    list(results_of([delayed(int)()] * 2, n_jobs=2))  # they begin without the path
    (tmp_path / "only_here.py").write_text("def function():\n    return 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    task = delayed(import_module("only_here").function)()
    with pytest.raises(RuntimeError, match="No module named 'only_here'. Install"):
        list(results_of([task] * 2, n_jobs=2))


def starved():
    """Ask for more memory than this process may have."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (2**32, before[1]))
    try:
        return np.ones(2**32)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_a_worker_out_of_memory_is_told():
    with pytest.raises(MemoryError, match="Unable to allocate 32.*fewer `n_jobs`"):
        list(results_of([delayed(starved)()] * 2, n_jobs=2))


def test_two_processes_share_one_memory(tmp_path):
    both = [begun(script(size=1000, memory=str(tmp_path))) for _ in range(2)]
    (one, told), (two, _) = (p.communicate(timeout=2 * PATIENCE) for p in both)
    assert [p.returncode for p in both] == [0, 0], told
    assert one == two
    alone = begun(script(size=1000)).communicate(timeout=2 * PATIENCE)[0]
    assert alone == one


def test_a_place_that_cannot_be_written_is_told_at_the_start(capsys):
    assert main(["--output", "/proc/nowhere/results"]) == 1
    told = capsys.readouterr().err
    assert "--output /proc/nowhere/results: it cannot be written" in told
    assert "local models" not in told


def limited(size):
    """Before a process begins: it cannot write more than so many bytes to a file."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_folder_that_cannot_be_written_is_told():
    as_nobody = "import os; os.geteuid() or os.seteuid(65534)"  # root may write there
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o555)
        command = script(f"{as_nobody}; {ALONE}", size=100, memory=folder)
        process = begun(command)
        _, told = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "PermissionError: `memory` must be a folder." in told
    assert folder in told and "Take a place where you may write" in told


@pytest.mark.parametrize("fit", [ALONE, SEARCH.replace(" * 8", "")])
def test_a_memory_that_is_full_is_told_and_the_fit_goes_on(fit, tmp_path):
    command = script(fit, size=200, memory=str(tmp_path))
    full = begun(command, preexec_fn=partial(limited, 512))
    found, told = full.communicate(timeout=2 * PATIENCE)
    assert full.returncode == 0
    assert "`memory` could not keep a result" in told and "Traceback" not in told
    whole = written(tmp_path)  # what is small enough
    again, told = begun(command).communicate(timeout=2 * PATIENCE)
    assert again == found and "memory" not in told
    assert whole.items() < written(tmp_path).items()


@pytest.mark.parametrize("size", [2**14, 2**17])
def test_a_full_disk_is_told_and_nothing_half_written_stays(size, tmp_path):
    command = [*PAPER[:3], "--realizations", "1", "--jobs", "1", "--output", "results"]
    home = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    process = begun(command, preexec_fn=partial(limited, size), cwd=tmp_path, env=home)
    _, told = process.communicate(timeout=2 * PATIENCE)
    assert process.returncode == 1
    assert "--output results: it cannot be written (File too large)" in told
    assert "Free space there" in told and "Traceback" not in told
    assert not (tmp_path / "results").exists()
    assert ("local models" in told) == (size > 2**16)


def test_a_folder_that_vanishes_is_told(tmp_path):
    process = begun([*PAPER, "--output", tmp_path / "results"])
    wait_for_points(tmp_path / ".results.done", 14)
    for i, folder in enumerate(tmp_path.glob(".results.*")):
        folder.rename(tmp_path / f"away {i}")  # at once, whatever is written meanwhile
    _, told = process.communicate(timeout=2 * PATIENCE)
    assert process.returncode == 1
    assert "The folder has vanished" in told
    nothing_left(process)
