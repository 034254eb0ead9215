"""The command line seen from outside: exit codes, messages, streams, and what it imports."""

from __future__ import annotations

import fcntl
import importlib.util
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from colmap_tco import cli
from colmap_tco.commands import COMMANDS
from colmap_tco.flags import settings
from colmap_tco.progress import Progress, clock, remaining

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("torch", "pycolmap", "open3d", "numba", "cv2", "kornia", "scipy")
NOT_FOR_THE_LIST = (*HEAVY, "numpy", "PIL", "tqdm")
PROGRAM = """
import sys
from colmap_tco.cli import main
from colmap_tco.commands import Command
table = {"example": Command("run the example", "tests.cli_examples:ExampleConfig", "tests.cli_examples:run")}
sys.exit(main(commands=table))
"""


def run(
    *words: str, program: str = PROGRAM, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """The program as a process, without the caller's settings of OpenMP where ``environment`` is given."""
    kept = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    return subprocess.run(
        [sys.executable, "-c", program, *words], cwd=ROOT, capture_output=True, text=True, check=False,
        env=None if environment is None else kept | environment,
    )  # fmt: skip


def test_success_prints_the_summary_on_stdout_alone() -> None:
    done = run("example", "scene", "--steps", "3", "--overwrite")
    assert done.returncode == 0
    assert done.stdout == "scene 3 True\n"
    assert "work 0/2" in done.stderr
    assert "scene 3" not in done.stderr


@pytest.mark.parametrize(
    ("failure", "code", "told"),
    [
        ("a", 3, "images/0.jpg is truncated: copy it again"),
        ("b", 4, "does not fit"),
        ("c", 5, "vggt.safetensors"),
        ("d", 6, "1 of 3 views failed"),
        ("e", 1, "ZeroDivisionError: division by zero; the option -v"),
        ("f", 4, "--max_image_size"),
        ("g", 4, "--max_image_size"),
        ("h", 3, "scene/mesh.ply: the system refuses it (Read-only file system)"),
        ("interrupt", 130, "interrupted"),
        ("terminate", 130, "stopped by SIGTERM"),
        ("terminate with COLMAP", 130, "stopped by SIGTERM"),
    ],
)
def test_each_failure_has_its_exit_code_and_one_sentence(failure: str, code: int, told: str) -> None:
    done = run("example", "scene", "-q", "--failure", failure)
    assert done.returncode == code
    message = done.stderr.splitlines()[-1]
    assert message.startswith("warning: " if code == 6 else "error: "), "what is partly done is done"
    assert told in message
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("words", [("-v", "example", "scene"), ("example", "scene", "-v")])
def test_verbose_shows_the_traceback(words: tuple[str, ...]) -> None:
    done = run(*words, "--failure", "e")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "cli_examples.py" in done.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("example", "scene", "--stepz", "3"), "unknown flag --stepz; did you mean --steps?"),
        (("example", "scene", "--no-overwrit"), "did you mean --no_overwrite?"),
        (("example", "scene", "--step", "3"), "did you mean --steps?"),
        (("example", "scene", "other"), "unexpected argument 'other'"),
        (("example", "scene", "--steps", "x"), "'x' is not a whole number"),
        (("example", "scene", "--steps", "-3"), "--steps must not be negative"),
        (("example", "scene", "--failure", "z"), "'z' is not one of"),
        (("example",), "WORKSPACE"),
        (("exmple", "scene"), "exmple"),
        ((), "COMMAND"),
    ],
)
def test_usage_errors_exit_2_with_the_remedy(words: tuple[str, ...], told: str) -> None:
    done = run(*words)
    assert done.returncode == 2
    assert told in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "None 1000"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE None"),
        ({"GOMP_SPINCOUNT": "5"}, "None 5"),
    ],
)
def test_idle_threads_soon_sleep_unless_told_otherwise(given: dict[str, str], told: str) -> None:
    """As the environment has it when the work begins, before which torch is not loaded."""
    done = run("example", "scene", "--failure", "environment", environment=given)
    assert done.stdout == f"{told} False\n"


def test_quiet_keeps_warnings_and_drops_progress() -> None:
    done = run("example", "scene", "-q")
    assert "the sky is falling" in done.stderr
    assert "work 0/2" not in done.stderr


def test_log_json_writes_one_object_a_line_and_nothing_else() -> None:
    done = run("example", "scene", "--log-json", "--failure", "a")
    entries = [json.loads(line) for line in done.stderr.splitlines()]
    assert all({"time", "level", "logger", "message"} <= entry.keys() for entry in entries)
    progress = next(entry for entry in entries if entry.get("stage"))
    assert (progress["stage"], progress["done"], progress["total"]) == ("work", 0, 2)
    assert entries[-1]["level"] == "error"
    assert entries[-1]["exit_code"] == 3
    assert any("the sky is falling" in entry["message"] for entry in entries if entry["level"] == "warning")


def test_log_json_covers_usage_errors() -> None:
    done = run("example", "scene", "--log_json", "--stepz", "3")
    assert json.loads(done.stderr)["exit_code"] == 2


def on_terminal(*words: str, columns: int = 80) -> str:
    """What the example writes to a stderr that is a terminal."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    command = [sys.executable, "-c", PROGRAM, *words]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=follower) as process:
        os.close(follower)
        seen = b""
        while chunk := _read(leader):
            seen += chunk
        process.wait()
    os.close(leader)
    return seen.decode()


def _read(leader: int) -> bytes:
    try:
        return os.read(leader, 4096)
    except OSError:  # how Linux says that the other end of a terminal was closed
        return b""


def test_the_bar_is_drawn_on_a_terminal_and_nowhere_else() -> None:
    assert "%|" in on_terminal("example", "scene")
    assert "%|" not in on_terminal("example", "scene", "--log_json")
    assert "%|" not in on_terminal("example", "scene", "-q")
    assert "%|" not in run("example", "scene").stderr
    assert "work 0/2" in on_terminal("example", "scene", columns=0)


IMPORTED = """
import sys
from colmap_tco.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    print("heavy:", *sorted(set(sys.modules) & set({heavy!r})))
    sys.exit(end.code)
"""


def imported_by_help(*words: str, of: tuple[str, ...]) -> list[str]:
    """Which modules ``of`` these a help text imports."""
    done = run(*words, "--help", program=IMPORTED.format(heavy=of))
    assert done.returncode == 0, done.stderr
    assert "usage: colmap-tco" in done.stdout
    return done.stdout.splitlines()[-1].split()[1:]


def test_the_list_of_commands_imports_nothing_heavy() -> None:
    assert imported_by_help(of=NOT_FOR_THE_LIST) == []


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_imports_nothing_heavy(name: str) -> None:
    if not _is_there(name):
        pytest.skip(f"the module of {name} is not there yet")
    assert imported_by_help(name, of=HEAVY) == []


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_in_the_table_has_a_configuration_and_a_function(name: str) -> None:
    if not _is_there(name):
        pytest.skip(f"the module of {name} is not there yet")
    command = COMMANDS[name]
    assert settings(cli._load(command.config))
    assert callable(cli._load(command.function))


def _is_there(name: str) -> bool:
    return importlib.util.find_spec(COMMANDS[name].config.partition(":")[0]) is not None


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.common])
def test_help_lists_the_common_flags_and_help_all_every_one(name: str) -> None:
    every = {setting.name for setting in settings(cli._load(COMMANDS[name].config))}
    common = set(COMMANDS[name].common.split())
    assert common < every
    program = "import sys; from colmap_tco.cli import main; sys.exit(main())"
    short, whole = (run(name, word, program=program).stdout for word in ("--help", "--help-all"))
    for told, names in ((short, common), (whole, every)):
        assert set(re.findall(r"^  --(?!help_all|log_json)(\w+)", told, re.M)) == names
    assert f"{len(every) - len(common)} more flags" in short and "more flags" not in whole


def test_version_is_printed() -> None:
    done = run("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("colmap-tco ")


def test_real_allocators_that_fail_are_known_as_out_of_memory() -> None:
    import numpy as np
    import torch

    with pytest.raises(MemoryError) as by_numpy:
        np.empty(1 << 55, np.uint8)
    with pytest.raises(RuntimeError) as by_torch:
        torch.empty(1 << 55, dtype=torch.uint8)
    for caught in (by_numpy, by_torch):
        assert cli.exit_code(caught.value) == 4
    assert cli.exit_code(torch.OutOfMemoryError("CUDA out of memory")) == 4
    assert cli.exit_code(RuntimeError("shapes do not match")) == 1


def test_the_fraction_of_a_planned_run_is_the_share_of_time_spent() -> None:
    progress = Progress()
    progress.plan({"views": 1, "optimise": 6, "fuse": 3})
    seen = [progress.fraction]
    progress.stage("views", 4)
    progress.advance(2)
    seen.append(progress.fraction)
    progress.stage("optimise", 3)  # leaves "views" half way: it counts as finished
    seen.append(progress.fraction)
    for _ in range(3):
        progress.advance()
        seen.append(progress.fraction)
    progress.stage("fuse", 0)
    seen.append(progress.fraction)
    assert seen == pytest.approx([0, 0.05, 0.1, 0.3, 0.5, 0.7, 0.7])


def test_the_estimate_is_exact_at_constant_speed() -> None:
    assert remaining(0.0, 0.0) is None
    for share in (0.1, 0.5, 1.0):
        assert remaining(200 * share, share) == pytest.approx(200 * (1 - share))


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (89, "89 s"), (91, "2 min"), (3599, "1 h 00 min"), (3900, "1 h 05 min")],
)
def test_durations_are_readable(seconds: float, text: str) -> None:
    assert clock(seconds) == text


def test_progress_refuses_stages_that_would_break_the_estimate() -> None:
    progress = Progress()
    with pytest.raises(RuntimeError, match="stage"):
        progress.advance()
    progress.plan({"views": 1})
    with pytest.raises(ValueError, match="not in the plan"):
        progress.stage("optimise", 3)
    progress.stage("views", 3)
    with pytest.raises(ValueError, match="there before"):
        progress.stage("views", 3)
    with pytest.raises(ValueError, match="positive"):
        progress.plan({"views": -1, "fuse": 2})


def test_lines_come_at_intervals(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="colmap_tco.progress")
    for interval, lines in ((0.0, 6), (1e6, 1)):
        caplog.clear()
        progress = Progress(interval=interval)
        progress.stage("optimise", 5)
        for step in range(5):
            progress.advance(loss=1 / (step + 1))
        assert len(caplog.records) == lines
    assert caplog.records[0].getMessage() == "optimise 0/5"
