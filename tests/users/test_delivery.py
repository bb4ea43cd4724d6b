"""Packages work outside of the checkout: a wheel, the same wheel built from an sdist, and users without a home."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from spectralzoom.flows.cli.main import VERBS, build_app, main
from spectralzoom.flows.settings.flags import KEYS
from tests.conftest import WeightsMaker

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("flows", "models", "storage", "pipeline")  # of the product, which a project may have too
PACKAGES = ("src", *FOLDERS)
BESIDE = ("pyproject.toml", "README.md", "LICENSE")
AS_NOBODY = ("setpriv", "--reuid=12345", "--regid=12345", "--clear-groups")  # a user without a name or a home
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"
USED = """
import json, sys
import spectralzoom
run = spectralzoom.survey(scene="field.png", weights="mine.safetensors", out=sys.argv[1])
plan = spectralzoom.plan(scene="farm", size="32x32", out=sys.argv[1])
print(json.dumps([spectralzoom.__version__, spectralzoom.__file__, str(run.report), len(plan["stages"])]))
"""


def run(words: Sequence[str | Path], cwd: Path, environment: Mapping[str, str] | None = None) -> str:
    """Return the output of a command; raise AssertionError with its messages if it fails."""
    given = [str(word) for word in words]
    ended = subprocess.run(given, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]
    assert "nonexistent" not in ended.stderr
    assert "atplotlib" not in ended.stderr
    return ended.stdout


def may_be_nobody(python: Path) -> bool:
    """Return whether this process may switch to another user who can run this interpreter with its packages.

    That user cannot enter a checkout below a folder of mode 0700, where the environment of the tests usually lies.
    """
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        return False
    words = [*AS_NOBODY, str(python), "-c", "import ctypes, decimal, lzma, ssl, numpy"]
    return subprocess.run(words, env={}, capture_output=True, check=False).returncode == 0


def own_packages(project: Path) -> None:
    """Make a project whose packages have the names of the product's folders, and cannot be imported."""
    for name in FOLDERS:
        (project / name).mkdir()
        (project / name / "__init__.py").write_text(f"raise ImportError('{name} of the project was imported')\n")


@pytest.fixture(scope="module")
def ground() -> Iterator[Path]:
    """Yield a folder that every user of the machine may enter, unlike pytest's folders."""
    with tempfile.TemporaryDirectory(prefix="spectralzoom-delivery-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the packages' files in git, outside of the checkout, so that the build uses no other files."""
    copy = tmp_path_factory.mktemp("tree")
    listed = run(["git", "ls-files", "-co", "--exclude-standard", *PACKAGES, *BESIDE], ROOT).splitlines()
    for name in filter(lambda one: (ROOT / one).exists(), listed):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, copy / name, follow_symlinks=False)
    return copy


@pytest.fixture(scope="module")
def wheel(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel that is built from an sdist."""
    made = tmp_path_factory.mktemp("dist")
    sdist = run([sys.executable, "-c", BUILD, "build_sdist", made], tree).splitlines()[-1]
    with tarfile.open(made / sdist) as packed:
        packed.extractall(made / "unpacked", filter="data")
    (unpacked,) = (made / "unpacked").iterdir()
    name = run([sys.executable, "-c", BUILD, "build_wheel", made], unpacked).splitlines()[-1]
    return made / name


@pytest.fixture(scope="module")
def installed(wheel: Path, ground: Path) -> Path:
    """Return the programs of a new environment: the wheel with this environment's dependencies, not the checkout."""
    venv.create(ground / "env", symlinks=True)
    (packages,) = (ground / "env").glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # whose own .pth files are not read
    pip = [sys.executable, "-m", "pip", "-q", "--python", ground / "env" / "bin" / "python", "install"]
    run([*pip, "--no-deps", "--no-compile", "--no-index", "--disable-pip-version-check", wheel], ground)
    return ground / "env" / "bin"


def test_the_wheel_contains_exactly_the_files_of_the_packages(tree: Path, wheel: Path) -> None:
    """The wheel contains every file of the packages, with weights and templates, byte by byte, and no other file."""
    with zipfile.ZipFile(wheel) as packed:
        found = {name: packed.read(name) for name in packed.namelist() if ".dist-info/" not in name}
    known = {}
    for name in PACKAGES:
        for path in (path for path in (tree / name).rglob("*") if path.is_file() and "egg-info" not in str(path)):
            file = path.relative_to(tree / "src" if name == "src" else tree).as_posix()
            known[file if name == "src" else f"spectralzoom/{file}"] = path.read_bytes()
    assert set(found) == set(known)
    assert [name for name in known if found[name] != known[name]] == []


def test_the_wheel_needs_no_home(installed: Path, ground: Path, scene_files: Path, make_weights: WeightsMaker) -> None:
    """Command and package run without HOME, as a user who may write to the archive and temporary files alone.

    Where no other user can read the packages, it is the user of the tests.
    """
    place, archive, temporary = (ground / name for name in ("place", "archive", "tmp"))
    for folder in (place, archive, temporary):
        folder.mkdir()
        folder.chmod(0o755 if folder == place else 0o777)
    own_packages(place)
    shutil.copyfile(scene_files / "scene.png", place / "field.png")
    shutil.copyfile(make_weights(), place / "mine.safetensors")
    nobody = AS_NOBODY if may_be_nobody(installed / "python") else ()
    bare = {"TMPDIR": str(temporary), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    version = run([*nobody, installed / "spectralzoom", "--version"], place, bare)
    told, file, report, planned = json.loads(run([*nobody, installed / "python", "-c", USED, archive], place, bare))
    listed = json.loads(run([*nobody, installed / "spectralzoom", "ls", archive, "--json"], place, bare))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert version.strip() == told == project["version"]
    assert Path(file).is_relative_to(installed.parent)
    assert Path(report).read_text(encoding="utf-8").lower().startswith("<!doctype html>")
    assert planned > 7
    assert [row["id"] for row in listed["runs"]] == [Path(report).parent.name]
    assert not list(temporary.glob("spectralzoom-*"))  # caches of libraries end with the process


DEPLOYED = """
from prefect.flows import load_flow_from_entrypoint
from spectralzoom.flows.prefect_flow import survey
print(load_flow_from_entrypoint(survey.to_deployment("north").entrypoint).name)
"""


def test_the_editable_path_holds_the_package_alone(tmp_path: Path) -> None:
    """No folder of the checkout can be imported by its own name."""
    code = "import importlib.util as u, sys; print([name for name in sys.argv[1:] if u.find_spec(name)])"
    assert (
        run([sys.executable, "-c", code, "spectralzoom", *FOLDERS, "tests", "docs"], tmp_path, {})
        == "['spectralzoom']\n"
    )


def test_links_that_git_wrote_as_text_are_named(tmp_path: Path) -> None:
    """As on Windows, where git makes no links by default: the import says what to do."""
    shutil.copytree(ROOT / "src", tmp_path / "src", symlinks=True)
    for name in FOLDERS:
        (tmp_path / "src" / "spectralzoom" / name).unlink()
        (tmp_path / "src" / "spectralzoom" / name).write_text(f"../../{name}")
    words = [sys.executable, "-c", "import spectralzoom"]
    ended = subprocess.run(words, cwd=tmp_path / "src", capture_output=True, text=True, check=False)
    assert ended.stderr.splitlines()[-1].startswith("ImportError: git wrote links of this checkout as text")


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_a_project_with_folders_of_the_same_names_plans_and_deploys(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Command, package and Prefect find the product's own modules; `test_the_wheel_needs_no_home` surveys."""
    own_packages(tmp_path)
    python = sys.executable if kind == "editable" else request.getfixturevalue("installed") / "python"
    bare = {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1", "HOME": str(tmp_path), "DO_NOT_TRACK": "1"}
    assert run([python, "-c", DEPLOYED], tmp_path, bare).split()[-1] == "survey"
    words = [python, "-m", "spectralzoom.flows.cli.main", "plan", "--size", "32x32", "--json"]
    assert json.loads(run(words, tmp_path, bare))["stages"]


def test_the_container_copies_every_package() -> None:
    """The image copies the files of the wheel, and its command is a survey."""
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    copied = [word for line in re.findall(r"^COPY (?!--from)(.*) \S+$", text, re.MULTILINE) for word in line.split()]
    assert set(copied) == {*PACKAGES, *BESIDE, "constraints.txt"}
    (asked,) = re.findall(r"^CMD (\[.*\])$", text, re.MULTILINE)
    words = json.loads(asked)
    assert words[-2:] == ["--out", "/archive"]
    build_app(listed=False).parse_args(words, exit_on_error=False, print_error=False)


def test_bash_completes_the_flags_of_a_verb(tmp_path: Path) -> None:
    """The completion script contains every verb and setting, and bash completes `survey --budg` to `--budget`."""
    script = tmp_path / "script"
    with pytest.raises(SystemExit) as ended:
        main(["completion", "--shell", "bash", "--output", str(script)])
    assert not ended.value.code
    assert all(re.search(rf"\b{verb.split()[-1]}\b", script.read_text()) for verb in VERBS)
    assert all(f"--{key.replace('_', '-')}" in script.read_text() for key in KEYS)
    typed = "COMP_WORDS=(spectralzoom survey --budg); COMP_CWORD=2; _spectralzoom; echo ${COMPREPLY[@]}"
    assert run(["bash", "-c", f"source {script}; {typed}"], tmp_path).split() == ["--budget"]
