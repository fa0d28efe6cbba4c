"""``graderd label``: a site's own frames become a frame set with truth, which ``classify`` then measures itself by."""

from __future__ import annotations

import csv
import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from graderd.cli.app import run_app
from graderd.cli.label import Labels, Page, make_frame_set
from graderd.core.soil import Zone
from graderd.perception.frame_set import MANIFEST, FrameSet, write_label
from tests.replay.test_recordings import RECORDINGS

pytestmark = pytest.mark.live


@contextmanager
def page_of(folder: Path) -> Iterator[tuple[Page, Labels]]:
    labels = Labels(FrameSet(folder))
    with Page(labels, 0) as page:
        thread = threading.Thread(target=page.serve)
        thread.start()
        try:
            yield page, labels
        finally:
            page.end()
            thread.join(10.0)


def asked(url: str, body: Any = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    with urllib.request.urlopen(urllib.request.Request(url, data), timeout=10.0) as answer:
        content = answer.read()
    return content if answer.headers["Content-Type"] == "image/jpeg" else json.loads(content)


def refused(url: str, body: Any = None) -> int:
    """The status with which it is refused."""
    with pytest.raises(urllib.error.HTTPError) as told:
        asked(url, body)
    told.value.close()
    return told.value.code


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The raw frame of a recording as a frame set."""
    folder = tmp_path_factory.mktemp("site") / "frames"
    make_frame_set(RECORDINGS[0], folder, None, 0.0)
    return folder


def test_a_label_given_on_the_page_is_in_the_manifest_and_classify_measures_by_it(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with page_of(site) as (page, labels):
        ((id_, label),) = asked(f"{page.url}frames")["frames"]
        assert label == ""
        picture = cv2.imdecode(np.frombuffer(asked(f"{page.url}picture/{id_}"), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape[0] > 100
        assert asked(f"{page.url}label", {"id": id_, "label": "right"}) == {"labelled": True}
    assert labels.given == {id_: Zone.RIGHT}
    assert FrameSet(site).entries[0].label is Zone.RIGHT
    assert run_app(["classify", str(site), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out.splitlines()[-1])["summary"]
    assert summary["accuracy"] == 1.0


def test_the_page_shows_the_operators_left_on_the_left(site: Path) -> None:
    labels = Labels(FrameSet(site))
    assert labels.mirrored, "this camera faces the blade from the front"
    shown = cv2.imdecode(np.frombuffer(labels.picture(labels.ids[0]), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    frame = FrameSet(site).frame(FrameSet(site).entries[0]).color_bgr
    other_way = np.abs(shown[:, ::-1].astype(int) - frame).mean()
    assert other_way < np.abs(shown.astype(int) - frame).mean() / 3.0


@pytest.mark.parametrize(
    "body",
    [{"id": "nobody", "label": "left"}, {"id": "00000", "label": "soil"}, {"label": "left"}, ["left"], "x" * 9000],
)
def test_nonsense_is_refused_and_changes_nothing(site: Path, body: Any) -> None:
    before = (site / MANIFEST).read_bytes()
    with page_of(site) as (page, _):
        assert refused(f"{page.url}label", body) == 400
    assert (site / MANIFEST).read_bytes() == before


def test_who_has_not_the_address_gets_nothing(site: Path) -> None:
    with page_of(site) as (page, _):
        for path in ("/", "/frames", "/x/label"):
            assert refused(page.url[: page.url.index("/", 8)] + path) == 404


def test_done_on_the_page_ends_it(site: Path) -> None:
    with Page(Labels(FrameSet(site)), 0) as page:
        thread = threading.Thread(target=page.serve)
        thread.start()
        assert asked(f"{page.url}done", {}) == {"done": True}
        thread.join(10.0)
        assert not thread.is_alive()


def test_a_label_leaves_everything_else_in_the_manifest(tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text('id,blade_angle_deg,weather,label\n001,3,"sun, dry",\n002,4,rain,left\n')
    write_label(tmp_path, "001", Zone.EVEN)
    write_label(tmp_path, "002", None)
    with (tmp_path / MANIFEST).open() as file:
        assert list(csv.DictReader(file)) == [
            {"id": "001", "blade_angle_deg": "3", "weather": "sun, dry", "label": "even"},
            {"id": "002", "blade_angle_deg": "4", "weather": "rain", "label": ""},
        ]
    assert [path.name for path in tmp_path.iterdir()] == [MANIFEST]
    (tmp_path / MANIFEST).write_text("id,blade_angle_deg\n001,3\n")
    write_label(tmp_path, "001", Zone.LEFT)
    assert (tmp_path / MANIFEST).read_text().splitlines() == ["id,label,blade_angle_deg", "001,left,3"]


def test_pictures_become_a_frame_set_that_can_be_labelled(tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number in range(2):
        cv2.imwrite(str(pictures / f"{number}.png"), np.full((80, 128, 3), 40 * number, np.uint8))
    (tmp_path / "c.toml").write_text("")
    make_frame_set(pictures, tmp_path / "set", tmp_path / "c.toml", 12.0)
    frames = FrameSet(tmp_path / "set")
    assert [entry.blade_angle_deg for entry in frames.entries] == [12.0, 12.0]
    assert frames.frame(frames.entries[1]).color_bgr[0, 0, 0] == 40
    assert Labels(frames).picture("00001")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "no such folder"),
        (["{tmp}", "--to", "{tmp}"], "is there already"),
        (["{tmp}"], "cannot be read"),
    ],
)
def test_what_cannot_be_labelled_is_told_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert run_app(["label", *(argument.format(tmp=tmp_path) for argument in arguments)]) == 2
    assert words in capsys.readouterr().err
