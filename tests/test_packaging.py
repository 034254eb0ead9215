"""What is installed: the wheel holds every module and the weights, and every import is declared."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

tomllib = pytest.importorskip("tomllib", reason="pyproject.toml is read with the tomllib of Python 3.11")

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tco", "colmap_tco")
WEIGHTS = "tco/backbones/data/probe.safetensors"
# Installed beside this package on purpose, as its own requirements clash; see the extra da3.
BESIDE = {"depth_anything_3"}
# Distributions whose modules have another name.
MODULES = {"cv2": "opencv-python-headless", "PIL": "pillow", "skimage": "scikit-image"}


def project() -> dict[str, Any]:
    with open(ROOT / "pyproject.toml", "rb") as file:
        table: dict[str, Any] = tomllib.load(file)["project"]
    return table


def requirements(*extras: str) -> list[Requirement]:
    """What the project needs on this Python."""
    table = project()
    texts = table["dependencies"] + [t for extra in extras for t in table["optional-dependencies"][extra]]
    every = [Requirement(text) for text in texts]
    return [r for r in every if r.marker is None or r.marker.evaluate()]


def pins() -> dict[str, str]:
    """Version of each distribution that constraints.txt holds on this Python."""
    found = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            requirement = Requirement(line)
            (specifier,) = requirement.specifier
            assert specifier.operator == "==", line
            if requirement.marker is None or requirement.marker.evaluate():
                found[canonicalize_name(requirement.name)] = specifier.version
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """A wheel built from a copy of the sources, with one more file of weights."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    (source / WEIGHTS).parent.mkdir(exist_ok=True)
    (source / WEIGHTS).write_bytes(b"weights")
    command = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "-w", "wheels", "."]
    subprocess.run([sys.executable, "-m", "pip", *command], cwd=source, check=True)
    (path,) = (source / "wheels").glob("*.whl")
    return zipfile.ZipFile(path)


def test_the_wheel_holds_every_module_and_the_weights_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    files = {path.relative_to(ROOT) for package in PACKAGES for path in (ROOT / package).rglob("*")}
    wanted = {str(path) for path in files if path.suffix in (".py", ".safetensors")} | {WEIGHTS}
    wanted |= {f"colmap_tco/page/built/{name}" for name in ("page.html", "OGL-LICENSE.txt")}
    wanted.add("colmap_tco/bench/data/published.json")
    assert packed == wanted


def test_the_wheel_installs_the_command(wheel: zipfile.ZipFile) -> None:
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "colmap-tco = colmap_tco.__main__:run" in wheel.read(name).decode()


def imported(path: Path) -> set[str]:
    """Top-level names of the modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


def test_every_third_party_import_is_declared() -> None:
    runtime = [extra for extra in project()["optional-dependencies"] if extra != "dev"]
    declared = {canonicalize_name(r.name) for r in requirements(*runtime)}
    used = {
        name for package in PACKAGES for path in (ROOT / package).rglob("*.py") for name in imported(path)
    }
    foreign = used - set(sys.stdlib_module_names) - set(PACKAGES) - BESIDE
    assert {canonicalize_name(MODULES.get(name, name)) for name in foreign} <= declared


def test_the_pins_lie_in_the_declared_ranges() -> None:
    versions = pins()
    for requirement in requirements("hub", "las", "da3", "evaluate", "dev"):
        name = canonicalize_name(requirement.name)
        assert name in versions, f"constraints.txt does not pin {name}"
        assert versions[name] in requirement.specifier, f"{name} {versions[name]} is outside its range"


def test_every_dependency_of_a_dependency_is_pinned() -> None:
    """A fresh machine must get the same versions tomorrow: nothing is left for pip to choose."""
    versions, seen, left = pins(), set(), requirements("hub", "las", "da3", "evaluate", "dev")
    while left:
        requirement = left.pop()
        name = canonicalize_name(requirement.name)
        key = (name, frozenset(requirement.extras))
        if key in seen:
            continue
        seen.add(key)
        assert name in versions, f"constraints.txt does not pin {name}"
        for text in metadata.requires(name) or []:
            inner = Requirement(text)
            extras = ["", *requirement.extras]
            if inner.marker is None or any(inner.marker.evaluate({"extra": extra}) for extra in extras):
                left.append(inner)


def test_the_makefile_has_the_promised_targets() -> None:
    text = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z]+):", text, re.MULTILINE))
    assert {"demo", "test", "lint", "bench", "clean"} <= targets


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The files that set a fresh clone up, without the rest of it."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt", ".ci/run"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def programs(folder: Path, **does: str) -> str:
    """A PATH with what the scripts need, and shell scripts with these names and contents."""
    folder.mkdir()
    for name in ("bash", "sh", "make", "dirname", "test", "python3", "touch", "rm", "true", "false"):
        (folder / name).symlink_to(str(shutil.which(name)))
    for name, script in does.items():
        path = folder / name.replace("_", "-")
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
    return str(folder)


def ci(checkout: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    # make hands its own flags down, which would change what is tested under `make test`
    inherited = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS")}
    if "PATH" not in environment:  # nothing is installed while tests run
        environment["PATH"] = programs(checkout / "programs", colmap="true", chromium="true")
    command = ["bash", str(checkout / ".ci/run")]
    return subprocess.run(
        command, env={**inherited, **environment}, cwd="/", capture_output=True, text=True, check=False
    )


def test_ci_sets_up_lints_and_tests_in_this_order(checkout: Path) -> None:
    done = ci(checkout, MAKEFLAGS="n")
    assert done.returncode == 0, done.stderr
    steps = ("--constraint constraints.txt", "ruff check", "ruff format --check", "mypy", "-m pytest")
    places = [done.stdout.find(step) for step in steps]
    assert -1 not in places
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("broken", "ran"),
    [(None, ["ruff check", "ruff format", "mypy", "pytest"]), ("ruff", ["ruff check"]), ("python", None)],
)
def test_ci_stops_at_the_first_failure(checkout: Path, broken: str | None, ran: list[str] | None) -> None:
    """With an installed environment whose programs do nothing but succeed, or fail where broken."""
    commands = checkout / ".venv/bin"
    commands.mkdir(parents=True)
    for name in ("ruff", "mypy", "python"):
        (commands / name).symlink_to(str(shutil.which("false" if name == broken else "true")))
    (checkout / ".venv/.installed").touch()
    done = ci(checkout)
    started = re.findall(
        r"^\.venv/bin/(?:python -m )?(ruff check|ruff format|mypy|pytest)", done.stdout, re.MULTILINE
    )
    assert started == (ran or ["ruff check", "ruff format", "mypy", "pytest"])
    assert (done.returncode == 0) is (broken is None)


@pytest.mark.parametrize("works", [True, False])
def test_ci_installs_programs_or_says_that_it_cannot(checkout: Path, works: bool) -> None:
    script = f"echo apt-get $* >> {checkout}/calls\n" + ("exit 0" if works else "exit 100")
    path = programs(checkout / "programs", apt_get=script)
    done = ci(checkout, PATH=path, MAKEFLAGS="n")
    assert done.returncode == 0, done.stderr
    calls = (checkout / "calls").read_text().splitlines()
    install = "apt-get install -y -qq --no-install-recommends"
    wanted = [["apt-get update -qq", f"{install} {name}"] for name in ("colmap", "chromium")]
    assert calls == [call for pair in wanted for call in (pair if works else pair[:1])]
    for name in ("colmap", "chromium"):
        assert (f"{name} could not be installed" in done.stderr) is not works
    assert "-m pytest" in done.stdout


def test_ci_does_not_install_what_is_there(checkout: Path) -> None:
    script = f"echo called >> {checkout}/calls"
    path = programs(checkout / "programs", apt_get=script, colmap="true", chromium="true")
    done = ci(checkout, PATH=path, MAKEFLAGS="n")
    assert done.returncode == 0, done.stderr
    assert not (checkout / "calls").exists()
