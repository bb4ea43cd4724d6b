"""Archives of strangers and of earlier versions: verbs stay inside, read what they can, and refuse the rest."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from flows.cli.main import main
from flows.publish import survey_command
from flows.publish.run_folder import Published
from flows.tasks.local_server import ServerUnavailable
from flows.tasks.open_survey import versions
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.manifests import _seal, _text
from storage.archive.records import read_run
from storage.archive.staging import file_hash
from tests.conftest import Survey
from tests.flows.conftest import CommandLine
from tests.storage.archive.test_no_files import CASES, Case, put
from tests.storage.small_archive import Small, flip, small_survey

pytestmark = pytest.mark.usefixtures("no_effects")


def _stored_as(archive: Archive, like: StageRef, params: dict[str, Any], inputs: Sequence[str]) -> StageRef:
    """A store of the second round: with the arrays of another, and the facts that the second round's had."""

    def build(path: Path) -> None:
        shutil.copytree(like.path, path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("manifest.json"))

    return archive.produce(like.stage, build, version=versions()[like.stage], params=params, inputs=inputs)[0]


def _publish_second_round(archive: Archive, one: Published) -> None:
    """A run of two rounds beside the run of one, with stages, products and plan named as they were."""
    receipt: Any = json.loads(json.dumps(one.receipt))
    rows = {row["name"]: row for row in receipt["stages"]}
    refs = {ref.key: ref for ref in archive.refs()}
    of = {name: refs[row["key"]] for name, row in rows.items() if row["key"]}
    again = _stored_as(
        archive,
        of["attend"],
        {"weights": "a", "round": 2},
        [of[name].key for name in ("rectify", "attend", "cut_patches")],
    )
    light = archive.manifest(of["capture_fine"])["params"]
    raw = _stored_as(archive, of["capture_fine"], {**light, "starts_s": [9.0]}, [again.key, of["choose_effects"].key])
    params = {"round": 2, "kernel": "catmull-rom"}
    patches = _stored_as(archive, of["cut_patches"], params, [again.key, raw.key, of["cut_patches"].key])
    made = {"attend_again": again, "capture_again": raw, "cut_again": patches}
    added = [rows["attend"] | {"name": name, "key": ref.key} for name, ref in made.items()]
    at = list(rows).index("draw_map")
    hashes = archive.manifest_hashes([*of.values(), *made.values()])
    for row, ref in zip(added, made.values(), strict=True):
        row["manifest_sha256"] = hashes[ref.uri]
    receipt["stages"][at:at] = added
    receipt["settings"]["rounds"] = 2
    round_of = {"seats": 4, "lines": 9, "sweeps": 1, "seconds": 2.0, "score": 1.0, "score_share": 0.5}
    receipt["plan"] |= {"rounds": [round_of, round_of], "second_move_s": 0.1}
    receipt["products"] |= {
        "attention": f"{again.uri}/attention.zarr",
        "plan_again": f"{again.uri}/plan.json",
        "raw_again": raw.uri,
        "patches": f"{patches.uri}/patches.zarr",
    }
    with archive.new_run("scene") as draft:
        for name in ("quicklook.png", "report.html"):
            draft.write_file(name, (one.folder / name).read_bytes())
            receipt["products"][name] = f"runs/{draft.id}/{name}"
        receipt["products"]["receipt.json"] = f"runs/{draft.id}/receipt.json"
        draft.write_file("receipt.json", json.dumps(receipt))
        draft.publish(survey="scene", settings=receipt["settings"], rests_on=hashes)


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory, one_survey: tuple[Path, Published]) -> Path:
    """An archive with a run of one round and, newer, one of two; not to be changed."""
    out = Path(shutil.copytree(one_survey[0], tmp_path_factory.mktemp("before") / "archive"))
    _publish_second_round(Archive.open(out), one_survey[1])
    return out


@pytest.fixture
def archive(before: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(before, tmp_path / "archive"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["ls"], "2 runs"),
        (["verify"], "are as published"),
        (["explain", "latest"], "it had two rounds of detail, which are no more"),
        (["compare", "previous", "latest"], "rounds"),
        (["gc", "--keep-days", "0"], "0 things went"),
        (["report", "--out", "OUT/history.html"], ""),
        (["export", "latest", "--out", "OUT/layers"], ""),
    ],
    ids=lambda given: given[0] if isinstance(given, list) else "",
)
def test_such_a_run_is_shown(
    words: list[str], told: str, archive: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    """Its stages have names that there are no longer, and settings that nobody can ask for; files for others too."""
    ended = command_line(words[0], archive, *(word.replace("OUT", str(tmp_path)) for word in words[1:]))
    assert ended.code == 0
    if words[0] in ("report", "export"):
        assert [
            path for path in tmp_path.rglob("*") if path.suffix in (".html", ".tif") and archive not in path.parents
        ]
    assert told in ended.out


@pytest.mark.parametrize("words", [["reprocess"], ["evaluate", "latest", "--controls"]], ids=lambda words: words[0])
def test_such_a_survey_is_not_asked_for_again(words: list[str], archive: Path, command_line: CommandLine) -> None:
    """One round would be another survey than the run's; what to do is said."""
    ended = command_line(words[0], archive, *words[1:])
    assert ended.code != 0
    assert "its survey had 2 rounds of detail, which never paid and were removed" in ended.out + ended.err
    assert len(Archive.open(archive).runs()) == 2


def test_damage_to_it_is_told_and_repaired_by_one_round(
    archive: Path, survey_png: Survey, command_line: CommandLine
) -> None:
    """Repair leaves all as it was and says why; a store that is taken out is made by a survey of one round."""
    (mosaic,) = Archive.open(archive).refs("rectify")
    shutil.rmtree(Archive.open(archive).runs()[0])  # the run of one round, which would repair it
    flip(next(mosaic.path.rglob("wavelength/c/0")), at=20)
    ended = command_line("verify", archive, "--repair")
    assert ended.code != 0
    assert "its survey had 2 rounds of detail" in ended.out
    assert mosaic.path.is_dir()
    shutil.rmtree(mosaic.path)
    survey_png(archive)
    assert command_line("verify", archive).code == 0


def test_one_round_is_no_setting_that_differs(survey_png: Survey, tmp_path: Path) -> None:
    """Earlier versions told it in every receipt: such a run is asked for as one of today."""
    published = survey_png(tmp_path, accuracy=False)
    archive, settings = Archive.open(tmp_path), published.receipt["settings"]
    with archive.new_run("scene") as draft:
        draft.write_file("receipt.json", json.dumps({**published.receipt, "settings": {**settings, "rounds": 1}}))
        draft.publish(survey="scene", settings={**settings, "rounds": 1})
    assert read_run(archive.runs()[-1], {}).settings == read_run(published.folder, {}).settings


SECRET = b"not of this archive"
LEADS = ("../../../secret", "../secret", "/etc/passwd", "stages/../../secret", "./secret", "secret\0", "..", "")


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a manifest, and seal it again as whoever made it could."""
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    content.pop("seal")
    change(content)
    path.write_text(_text(content | {"seal": _seal(content)}))


def list_file(small: Small, lead: str) -> None:
    """A store lists a file that is no file of its own."""
    rewrite(small.mosaic.path, lambda facts: facts["files"].update({lead: {"sha256": "0" * 64, "size": len(SECRET)}}))


def rest_on(small: Small, lead: str) -> None:
    """A store was made of something elsewhere."""
    rewrite(small.mosaic.path, lambda facts: facts.update(inputs=[lead, f"capture/{lead}"]))


def call_itself(small: Small, lead: str) -> None:
    """A store says that it is another stage's, elsewhere."""
    rewrite(small.mosaic.path, lambda facts: facts.update(stage=lead, key=lead))


def name_products(small: Small, lead: str) -> None:
    """A run's products, stages and what it rests on lie elsewhere."""
    receipt = json.loads((small.run / "receipt.json").read_text())
    receipt["products"] = {"class_map": lead, "mosaic": f"stages/rectify/{lead}"}
    receipt["stages"] = [{"name": lead, "key": lead, "state": "ran", "manifest_sha256": "0" * 64}]
    text = json.dumps(receipt).encode()
    (small.run / "receipt.json").write_bytes(text)
    entry = {"sha256": file_hash(small.run / "receipt.json"), "size": len(text)}
    rewrite(
        small.run,
        lambda facts: facts.update(files={"receipt.json": entry}, rests_on={lead: "0" * 64, f"runs/{lead}": "0" * 64}),
    )


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize("change", [list_file, rest_on, call_itself, name_products])
def test_no_verb_leaves_the_archive(
    tmp_path: Path,
    change: Callable[[Small, str], None],
    lead: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each verb ends with an answer or one message; what lies beside the archive stays, and none of it is shown."""

    def no_server(*given: object) -> None:  # else each repair waits for one
        raise ServerUnavailable("none here")

    monkeypatch.setattr(survey_command, "_prefect_server", no_server)
    root = tmp_path / "archive"
    change(small_survey(Archive.open(root), simulated=False), lead)
    secrets = [tmp_path / "secret", root / "secret", root / "stages" / "secret"]
    for path in secrets:
        path.write_bytes(SECRET)
    for verb in (
        ["ls"],
        ["explain", "class_map"],
        ["explain", "rectify"],
        ["verify"],
        ["export"],
        ["gc", "--keep-days", "0", "--raw-too"],
        ["verify", "--repair"],
    ):
        with pytest.raises(SystemExit) as ended:
            main([verb[0], str(root), *verb[1:]])
        assert ended.value.code in (0, 1, 2, 3), verb
        shown = capsys.readouterr()
        assert "defect" not in shown.err + shown.out, (verb, shown.err)
        assert SECRET.decode() not in shown.err + shown.out
        assert secrets[0].read_bytes() == SECRET, verb
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["archive", "secret"]


@pytest.mark.parametrize("case", CASES)
def test_no_verb_waits_or_follows(case: Case, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pipes and links where files and folders should be: each verb ends, verify with 1, and no defect is met."""
    root, out = tmp_path / "archive", str(tmp_path / "out")
    uri = put(small_survey(Archive.open(root)), case)
    for verb, *more in (
        ("ls",),
        ("explain", "class_map"),
        ("report", "--out", f"{out}.html"),
        ("export", "--out", out),
        ("gc", "--dry-run"),
        ("verify",),
    ):
        with pytest.raises(SystemExit) as ended:
            main([verb, str(root), *more])
        shown = capsys.readouterr()
        assert ended.value.code in (0, 1, 2, 3), (verb, shown.err)
        assert "defect" not in shown.err + shown.out, (verb, shown.err)
    assert ended.value.code == 1
    assert uri in shown.out
