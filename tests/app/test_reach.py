"""No file is read but what was opened or uploaded, and an upload is a log or a model or one line."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from harness.app.reach import SessionFiles
from harness.errors import InputError


async def _content(text: bytes) -> AsyncIterator[bytes]:
    yield text


def take(reach: SessionFiles, name: str, text: bytes = b"t,u,y\n") -> str:
    return asyncio.run(reach.take(name, _content(text)))


def test_the_opened_folder_is_listed_and_read(reach: SessionFiles, folder: Path) -> None:
    (folder / "inner").mkdir()
    (folder / "inner" / "arm.urdf").write_text("<robot/>")
    (folder / "notes.md").write_text("no data")
    assert reach.names() == {"logs": ["log.csv"], "models": ["inner/arm.urdf"]}
    assert reach.path("log.csv").read_text().startswith("time")


@pytest.mark.parametrize(
    "name", ["../secret.csv", "inner/../../secret.csv", "/etc/passwd", "link.csv", "a\0b", "x" * 5000]
)
def test_nothing_outside_of_it_is(reach: SessionFiles, folder: Path, name: str) -> None:
    (folder / "link.csv").symlink_to(folder.parent / "secret.csv")
    with pytest.raises(InputError, match="outside of what was opened"):
        reach.path(name)


def test_of_an_opened_file_its_neighbours_are_not(folder: Path) -> None:
    (folder / "other.csv").write_text("a\n")
    reach = SessionFiles(folder / "log.csv", folder.parent / "work")
    assert reach.names()["logs"] == ["log.csv"]
    assert reach.path("log.csv") == folder / "log.csv"
    with pytest.raises(InputError, match="outside of what was opened"):
        reach.path("other.csv")


def test_the_records_of_a_data_set_lie_in_the_folder(reach: SessionFiles, folder: Path) -> None:
    text = 'name="a"\n[signals.u]\nrole="input"\nunit="V"\n[signals.y]\nrole="output"\nunit="m"\n[[runs]]\nfile="{}"\n'
    (folder / "dataset.toml").write_text(text.format("log.csv"))
    reach.runs_within(folder / "dataset.toml")
    (folder / "dataset.toml").write_text(text.format("../secret.csv"))
    with pytest.raises(InputError, match="a record outside of what was opened"):
        reach.runs_within(folder / "dataset.toml")


def test_an_upload_keeps_its_name_and_can_be_read(reach: SessionFiles) -> None:
    first, second = take(reach, "my log.csv"), take(reach, "my log.csv", b"other")
    assert (first, second) == ("uploaded/1/my log.csv", "uploaded/2/my log.csv")
    assert reach.path(second).read_bytes() == b"other"
    assert reach.names()["logs"] == ["log.csv", first, second]


@pytest.mark.parametrize("name", ["", "../x.csv", "a/b.csv", "a\\b.csv", ".csv", "n" * 300 + ".csv"])
def test_an_upload_with_a_strange_name_is_refused(reach: SessionFiles, name: str) -> None:
    with pytest.raises(InputError, match="name of an upload"):
        take(reach, name)


@pytest.mark.parametrize("name", ["run.exe", "mine.py", "model.xml", "dataset.toml", "README"])
def test_an_upload_of_another_kind_is_refused(reach: SessionFiles, name: str) -> None:
    with pytest.raises(InputError, match="an upload of this kind"):
        take(reach, name)


def test_an_empty_upload_is_refused_and_leaves_nothing(reach: SessionFiles) -> None:
    with pytest.raises(InputError, match="size of an upload"):
        take(reach, "log.csv", b"")
    assert reach.uploads == []
    assert not [path for path in reach.work.rglob("*") if path.is_file()]


def test_what_is_not_there_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to open"):
        SessionFiles(tmp_path / "none", tmp_path)
