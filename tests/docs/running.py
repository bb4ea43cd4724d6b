"""Run the blocks of a page: commands in this process, Python with the names of its page, TOML by its loader.

The comment before a block, `<!-- test: WORDS -->`, changes how it is run:

    with FLAGS      add the flags to each command: a smaller size, or no wait for a server; FEW stands for bands of the
                    farm that suffice for its weights
    parses          do not run: parse the words of every command, and check that targets and files exist
    bucket          s3://bucket/prefix is an archive on the S3 server of the tests
    tree FLAGS      run in one process with a copy of the source folders and tests, to which the page's files and
                    changes were added; add the flags to the first command
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import Any

from spectralzoom.flows.cli.main import build_app, main
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.storage.readers.scene_toml import load_scene_settings
from tests.docs.pages import ROOT, Block
from tests.flows.conftest import FEW_BANDS
from tests.source_paths import python_path

SHOWN = ("text",)  # program output and pictures of letters: nothing to run
BUILT = ("{toctree}", "{eval-rst}")  # run by `make docs`
BUCKET = "s3://bucket/prefix"
EACH = """
import json, sys
from spectralzoom.flows.cli.main import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit as ended:
        assert not ended.code, words
"""


@dataclass
class Reader:
    """A reader who goes through one page and follows its blocks in a folder."""

    folder: Path
    bucket: str | None = None
    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "page"})

    def follow(self, block: Block) -> None:
        """Run one block; raise AssertionError with its place if it fails."""
        word, _, rest = block.mark.partition(" ")
        if block.language in (*SHOWN, *BUILT):
            assert not block.mark, f"{block.place}: nothing of a {block.language} block is tested"
        elif block.language == "sh":
            assert word in ("", "with", "parses", "bucket", "tree"), f"{block.place}: {block.mark}?"
            for command in commands_of(block):
                self._command(block, command, word, rest)
            if word == "tree":
                self._elsewhere(block, rest)
        elif block.language == "python":
            self._python(block)
        elif block.language == "toml":
            self._toml(block)
        elif block.language == "diff":
            self._change(block)
        else:
            raise AssertionError(f"{block.place}: no test runs a block of {block.language or 'no language'}")

    @property
    def tree(self) -> Path:
        """Return a copy of the folders that a page may add to."""
        root = self.folder / "tree"
        if not root.exists():
            for name in ("pipeline", "models", "storage", "flows", "src", "tests"):
                # with bytecode, valid for files of the same dates
                shutil.copytree(ROOT / name, root / name, symlinks=True)
            shutil.copy(ROOT / "pyproject.toml", root)
        return root

    def _command(self, block: Block, command: str, word: str, rest: str) -> None:
        words = shlex.split(command.partition(" '>' ")[0])
        if word == "tree" and words[0] == "pytest":
            return
        check_words(words, block.place)
        if word == "parses":
            return
        assert Path(words[0]).name == "spectralzoom", f"{block.place}: only spectralzoom is run; say what is to parse"
        if word == "tree":
            return  # all are run together
        flags = shlex.split(rest.replace("FEW", FEW_BANDS))
        given = [found for one in (*words[1:], *flags) for found in self._matching(one)]
        if word == "bucket":
            assert self.bucket is not None
            given = [one.replace(BUCKET, self.bucket) for one in given]
        code = run_here(given)
        assert code == 0, f"{block.place}: {command} ended with {code}"

    def _matching(self, word: str) -> list[str]:
        """Expand the stars of a word as a shell does; return the word itself if it has none or no file matches."""
        if "*" not in word:
            return [word]
        return sorted(path.relative_to(self.folder).as_posix() for path in self.folder.glob(word)) or [word]

    def _elsewhere(self, block: Block, flags: str) -> None:
        """Run the commands with the copy of the folders, in a separate process; pytest runs in the copy."""
        (program, *first), *others = map(shlex.split, commands_of(block))
        environment = {**os.environ, "PYTHONPATH": python_path(self.tree)}
        words = [[*first, *shlex.split(flags)], *(one[1:] for one in others)]
        tests = program == "pytest"
        command = [sys.executable, *(["-m", "pytest", *first] if tests else ["-c", EACH, json.dumps(words)])]
        cwd = self.tree if tests else self.folder
        ended = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, f"{block.place}: {(ended.stdout + ended.stderr)[-2000:]}"

    def _python(self, block: Block) -> None:
        if block.file is not None:  # a new file in the copy of the folders
            path = self.tree / block.file
            assert path.parent.is_dir(), f"{block.place}: there is no folder {path.parent.relative_to(self.tree)}"
            assert not path.exists(), f"{block.place}: {block.file} is there already"
            path.write_text(block.text, encoding="utf-8")
            return
        code = compile("\n" * (block.line - 1) + block.text, str(block.page), "exec", dont_inherit=True)
        exec(code, self.names)

    def _change(self, block: Block) -> None:
        """Apply a diff to the file of the copy that its first line names; each part must match exactly one place."""
        first, _, rest = block.text.partition("\n")
        path = self.tree / first.removeprefix("--- ")
        text = path.read_text(encoding="utf-8")
        for part in re.split(r"^@@\n", rest, flags=re.MULTILINE):
            lines = part.splitlines(keepends=True)
            old = "".join(line[1:] for line in lines if line[:1] != "+")
            new = "".join(line[1:] for line in lines if line[:1] != "-")
            known = text.count(f"\n{old}")
            assert known == 1, f"{block.place}: {path.relative_to(self.tree)} has no such lines, or several: {old}"
            text = text.replace(f"\n{old}", f"\n{new}")
        path.write_text(text, encoding="utf-8")

    def _toml(self, block: Block) -> None:
        """Load a block as scene.toml or as settings; a file name in its first line keeps it for later blocks."""
        path = self.folder / (block.file or f"line-{block.line}.toml")
        path.write_text(block.text, encoding="utf-8")
        if path.name == "scene.toml":
            load_scene_settings(path)
        else:
            load_settings(path)


def run_here(words: list[str]) -> int:
    """Run the command line in this process and return the exit code."""
    try:
        main(words)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def commands_of(block: Block) -> list[str]:
    """Return the commands of a block: continued lines joined, comments removed, variables filled in."""
    known = {"DATA": "data"}
    found = []
    for line in block.text.replace("\\\n", " ").splitlines():
        bare = shlex.join(shlex.split(Template(line).safe_substitute(known), comments=True))
        setting = re.fullmatch(r"([A-Z_]+)=(\S*)", bare)
        if setting:
            known[setting[1]] = setting[2]
        elif bare:
            found.append(bare)
    return found


def check_words(words: list[str], place: str) -> None:
    """Refuse a command with an unknown verb, flag, target, file or benchmark."""
    program, *given = [Path(words[0]).name, *words[1:]]
    if program == "spectralzoom":
        build_app(listed=False).parse_args(given, exit_on_error=False, print_error=False)
    elif program == "make":
        phony = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert phony is not None
        assert {word for word in given if "=" not in word} <= set(phony[1].split()), f"{place}: make {given}?"
    elif program in ("python", "pytest"):
        check_python(program, given, place)
    else:
        assert program in ("open", "cd", "git", "pip"), f"{place}: who knows {program}?"


def check_python(program: str, given: list[str], place: str) -> None:
    """Check that a module, file or benchmark exists."""
    if given[0] == "-m":
        assert importlib.util.find_spec(given[1]) is not None, f"{place}: there is no module {given[1]}"
        return
    assert (ROOT / given[0]).exists(), f"{place}: there is no {given[0]}"
    if program == "python" and given[0] == "tests/benchmarks":
        asked = {word for word in given[1:] if not word.startswith("-") and word.islower()}
        there = {path.stem.removeprefix("bench_") for path in (ROOT / given[0]).glob("**/bench_*.py")}
        assert asked <= there, f"{place}: no benchmark {asked - there}"
