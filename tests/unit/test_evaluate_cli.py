"""``graderd evaluate``: the experiment file, every kind of scan, the table, the page, one line for what is wrong."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import plyfile
import pytest

from graderd.cli.app import run_app
from graderd.config import Config
from graderd.core.attitude import UNMEASURED
from graderd.core.soil import SoilObservation, Zone
from graderd.evaluation.ground import F64
from graderd.hal.camera import Frame
from graderd.record.files import RecordingFile
from graderd.record.frames import Judged, messages_of
from graderd.simulator.camera.top import TopCamera, save
from harness.top_view import HALF_VIEW, heap, trapezoid

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("evaluate cli")]  # one set of scans for all

Captured = pytest.CaptureFixture[str]
GUIDE = Path(__file__).parents[2] / "docs" / "operators" / "evaluation.md"
WIDTH = trapezoid(100.0, 250.0, 640.0, 70.0)
HEAP = heap(WIDTH, -200.0, 200.0, 60.0)


def layer(height_mm: float) -> Any:
    return heap(trapezoid(0.0, 900.0, 1000.0, height_mm), -220.0, 220.0, 60.0)


def camera(seed: int) -> TopCamera:
    return TopCamera(height_mm=1300.0, pitch_deg=2.0, roll_deg=-1.0, noise_px=0.15, seed=seed, lens=HALF_VIEW)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scans that the guide's experiment names, and the experiment itself."""
    folder = tmp_path_factory.mktemp("experiment")
    states = {
        "flat-15-1-before": heap(trapezoid(0.0, 200.0, 600.0, 120.0), -200.0, 200.0, 60.0),
        "flat-15-1-after": layer(46.0),
        "flat-15-2-after": layer(47.0),
        "flat-45-1-after": layer(53.0),
        "flat-45-2-after": layer(53.6),
        "left-30-1-after": HEAP,
    }
    for seed, (name, surface) in enumerate(states.items()):
        save(folder, name, camera(seed).scans_mm(surface, 3), HALF_VIEW)
    (folder / "flat-15-1.csv").write_text("t_s,load_n\n0.0,600\n0.1,700\n0.2,\n0.3,650\n")
    text = re.search(r"```toml\n(.*?)```", GUIDE.read_text("utf-8"), re.DOTALL)
    assert text is not None
    (folder / "experiment.toml").write_text(text[1], encoding="utf-8")
    return folder


def objects(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def evaluated(path: Path, capsys: Captured) -> dict[tuple[str, float, str], dict[str, Any]]:
    assert run_app(["evaluate", str(path), "--json"]) == 0
    return by_measure(objects(capsys.readouterr().out))


def by_measure(told: list[dict[str, Any]]) -> dict[tuple[str, float, str], dict[str, Any]]:
    assert told[-1]["event"] == "evaluation_finished"
    return {(row["case"], row["angle_deg"], row["measure"]): row for row in told[-1]["rows"]}


def one_trial(folder: Path, name: str, lines: str, head: str = "") -> Path:
    path = folder / f"{name}.toml"
    case = '[[case]]\nname = "heap"\nwork = "scattering"\n[[case.trial]]\nangle_deg = 15\n'
    path.write_text(f'name = "{name}"\n{head}\n{case}{lines}\n', encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def results(folder: Path) -> Path:
    """The guide's experiment evaluated, in a folder that was not there."""
    out = folder / "new" / "out"
    with pytest.MonkeyPatch.context() as patch, (folder / "said.jsonl").open("w") as said:
        patch.setattr("sys.stdout", said)
        assert run_app(["evaluate", str(folder / "experiment.toml"), "--json", "--save", str(out)]) == 0
    return out


def test_the_guides_experiment(folder: Path, results: Path) -> None:
    told = objects((folder / "said.jsonl").read_text())
    assert [each["event"] for each in told].count("trial_evaluated") == 5
    rows = by_measure(told)
    for row in rows.values():
        assert list(row) == ["case", "angle_deg", "measure", "value", "low", "high", "trials_n"]
    low, high = (rows["Flattening work", angle, "height_difference_mm"] for angle in (15.0, 45.0))
    assert low["value"] == pytest.approx(-3.5, abs=0.7)
    assert high["value"] == pytest.approx(3.3, abs=0.7)
    assert low["low"] < low["value"] < low["high"]
    assert low["trials_n"] == 2
    assert rows["Flattening work", 15.0, "blade_load_n"]["value"] == pytest.approx((650.0 + 655.0) / 2)
    assert rows["Flattening work", 15.0, "blade_load_max_n"]["value"] == 700.0
    assert rows["Flattening work", 15.0, "volume_moved_l"]["trials_n"] == 1
    scatter = "Scattering work (soil on left side)"
    assert rows[scatter, 30.0, "spread_extreme_mm"]["value"] == pytest.approx(586.0, rel=0.03)
    assert rows[scatter, 30.0, "spread_mass_95_mm"]["low"] < rows[scatter, 30.0, "spread_mass_95_mm"]["high"]
    assert (scatter, 30.0, "spread_extreme_without_carried_mm") in rows


def test_files_for_spreadsheets_and_a_page(results: Path) -> None:
    out = results
    with (out / "rows.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {"case", "angle_deg", "measure", "value", "deviation", "low", "high", "trials_n"} == set(rows[0])
    trials = (out / "trials.csv").read_text("utf-8").splitlines()
    assert len(trials) > 20
    differences = (out / "differences.csv").read_text("utf-8")
    assert "Flattening work,height_difference_mm,15,45,-6" in differences
    html = (out / "index.html").read_text("utf-8")
    assert html.count("<svg") == len({(row["case"], row["measure"]) for row in rows})
    # A map for each trial with scans, before and difference for the one that has scans of before, a scale for each case
    # and one for the difference.
    assert html.count("data:image/png;base64,") == 5 + 2 + 2 + 1
    told = re.findall(r"alt='(before|after|difference), trial 1 at 15 degrees", html)
    assert told == ["before", "after", "difference"]
    assert re.search(r"15°, trial 1, 3 scans, \d+\.\d+ l moved", html)
    assert "nan" not in re.sub(r"base64,[^']+", "", html)
    assert "http" not in html  # needs nothing beside it


def as_npy_mm(path: Path, scans: list[Any]) -> str:
    np.save(path / "stack.npy", np.stack(scans))
    return "stack.npy"


def as_npy_m(path: Path, scans: list[Any]) -> str:
    depth = np.stack(scans).astype(np.float32) / 1000.0
    depth[depth == 0.0] = np.nan
    np.save(path / "metres.npy", depth)
    return "metres.npy"


def points_m(scan: Any) -> F64:
    """As a scanner beside the bed has it: z up, x forward."""
    lens = HALF_VIEW
    v, u = np.nonzero(scan)
    z = scan[v, u] / 1000.0
    return np.column_stack((-(v - lens.cy) / lens.fy * z, -(u - lens.cx) / lens.fx * z, -z))


def as_ply(path: Path, scans: list[Any]) -> str:
    for number, scan in enumerate(scans):
        points = points_m(scan)
        vertices = np.array([tuple(point) for point in points], dtype=[(axis, "f8") for axis in "xyz"])
        plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")]).write(str(path / f"{number}.ply"))
    return "?.ply"


def as_las(path: Path, scans: list[Any]) -> str:
    for number, scan in enumerate(scans):
        header = laspy.LasHeader(point_format=0, version="1.2")
        header.scales = np.full(3, 1e-5)
        cloud = laspy.LasData(header)
        cloud.xyz = points_m(scan)
        cloud.write(str(path / f"{number}.las"))
    return "?.las"


def test_every_kind_of_file_gives_the_same(tmp_path: Path, capsys: Captured) -> None:
    scans = camera(8).scans_mm(HEAP, 3)
    pattern = save(tmp_path, "heap", scans, HALF_VIEW)
    values = []
    for name in (
        pattern,
        as_npy_mm(tmp_path, scans),
        as_npy_m(tmp_path, scans),
        as_ply(tmp_path, scans),
        as_las(tmp_path, scans),
    ):
        rows = evaluated(one_trial(tmp_path, "heap", f'after = ["{name}"]'), capsys)
        values.append(rows["heap", 15.0, "spread_extreme_mm"]["value"])
    assert values == pytest.approx([values[0]] * 5, abs=0.5)


def test_which_edge_of_the_picture_lies_forward(tmp_path: Path, capsys: Captured) -> None:
    """A picture turned, and told so, is the same bed; turned and not told, its length is taken for its width."""
    scans = np.stack(camera(8).scans_mm(HEAP, 2))
    turned = replace(HALF_VIEW, width=240, height=848, cx=HALF_VIEW.cy, cy=HALF_VIEW.cx)
    widths = {}
    for quarter, travel in enumerate(("up", "left", "down", "right")):
        save(tmp_path, "heap", [], turned if quarter % 2 else HALF_VIEW)
        np.save(tmp_path / "turned.npy", np.rot90(scans, quarter, axes=(1, 2)))
        for told in {"up": ("up",), "left": ("left", "up")}.get(travel, (travel,)):
            rows = evaluated(one_trial(tmp_path, "t", 'after = ["turned.npy"]', f'travel = "{told}"'), capsys)
            widths[travel, told] = rows["heap", 15.0, "spread_extreme_mm"]["value"]
    right = widths["up", "up"]
    assert [widths[travel, travel] for travel in ("left", "down", "right")] == pytest.approx([right] * 3, abs=1.5)
    assert widths["left", "up"] < 0.8 * right


def test_the_study(capsys: Captured) -> None:
    assert run_app(["evaluate", "--study", "--json"]) == 0
    *_, last = objects(capsys.readouterr().out)
    (left,) = (row for row in last["rows"] if row["angle_deg"] == 30 and "left" in row["case"])
    assert left["value"] == pytest.approx(525.32)
    assert left["trials_n"] == 5
    assert run_app(["evaluate", "--study"]) == 0
    text = capsys.readouterr().out
    assert "13.2 % against 45°" in text
    assert "30° less 45°" in text
    assert "61.38" in text


AFTER = 'after = ["heap-*.png"]'


HEAD = 'name = "x"\n[[case]]\nname = "a"\nwork = "scattering"\n'
TRIAL = "trial = [{angle_deg = 1, measured = {a_mm = 1}}]"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "name: Field required"),
        ("name = ", "not valid TOML"),
        ('name = "x"\ncase = []', ":2: case: at least one belongs here"),
        (HEAD.replace("scattering", "digging") + TRIAL, ":4: case[1].work"),
        (
            HEAD + "[[case.trial]]\nangel_deg = 15",
            ":6: case[1].trial[1].angel_deg: unknown key. Did you mean case[1].trial[1].a",
        ),
        (HEAD + "[[case.trial]]\nangle_deg = 15", ":5: case[1].trial[1]: nothing to evaluate; name scans in 'after'"),
        (
            HEAD.replace("scattering", "flattening") + 'trial = [{angle_deg = 1, after = ["a.npy"]}]',
            "set target_height_mm",
        ),
        (
            HEAD + "trial = [{angle_deg = 1, measured = {a = 1}}]",
            ":5: case[1].trial[1].measured: 'a' is no measure with its",
        ),
        ("area = {x_mm = [3, 1]}\n" + HEAD + TRIAL, ":1: area.x_mm: write the smaller end first"),
        ('spread = ["widest"]\n' + HEAD + TRIAL, ":1: spread[1]: Input should be 'extreme'"),
        (HEAD + TRIAL + "\n" + HEAD.partition("\n")[2] + TRIAL, "two cases are named 'a'"),
        ('cloud_travel = "-z"\n' + HEAD + TRIAL, "the same axis"),
    ],
)
def test_a_bad_experiment_file_is_told_with_its_place(
    tmp_path: Path, text: str, complaint: str, capsys: Captured
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text, encoding="utf-8")
    assert run_app(["evaluate", str(path)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert complaint in said.err
    assert all(line.startswith(f"graderd: {path}") for line in said.err.splitlines())
    assert run_app(["evaluate", str(path), "--json"]) == 2
    assert "error" in objects(capsys.readouterr().out)[-1]


@pytest.mark.parametrize(
    ("after", "complaint"),
    [
        ("nothing-*.png", "heap, trial[1]: no file is named 'nothing-*.png'"),
        ("../../**/", "no file is named"),
        ("notes.txt", "notes.txt: .txt is none of .npy, .png, .mcap, .ply, .las"),
        ("eight.png", "eight.png: not a 16-bit grey PNG"),
        ("small.npy", "small.npy: is 8x5, its camera file says 848x240"),
        ("blind.npy", "blind.npy: no pixel has depth"),
        ("words.npy", "words.npy: holds no depth picture"),
        ("broken.npy", "broken.npy: not a NumPy file"),
        ("huge.npy", "huge.npy: not a NumPy file"),
        ("/", "'/' is no name or pattern of files"),
        (".", "'.' is no name or pattern of files"),
        ("broken.ply", "broken.ply: not a PLY file"),
        ("broken.las", "broken.las: not a readable LAS file"),
        ("bare.npy", "heap, trial[1]: no soil is to be seen"),
        ("noise.npy", "heap, trial[1]: heights scatter"),
    ],
)
def test_a_bad_scan_is_one_line(tmp_path: Path, after: str, complaint: str, capsys: Captured) -> None:
    save(tmp_path, "heap", [], HALF_VIEW)
    (tmp_path / "notes.txt").write_text("x")
    cv2.imwrite(str(tmp_path / "eight.png"), np.zeros((5, 5), np.uint8))
    np.save(tmp_path / "small.npy", np.ones((5, 8), np.uint16))
    np.save(tmp_path / "blind.npy", np.zeros((240, 848), np.uint16))
    np.save(tmp_path / "words.npy", np.array(["a", "b"]))
    np.save(tmp_path / "bare.npy", np.stack(camera(1).scans_mm(lambda x, _: 0.0 * x, 2)))
    np.save(tmp_path / "noise.npy", np.random.default_rng(1).integers(400, 2000, (240, 848)).astype(np.uint16))
    huge = np.lib.format.header_data_from_array_1_0(np.zeros((1, 240, 848))) | {"shape": (1_000_000, 240, 848)}
    with (tmp_path / "huge.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, huge)
    for name in ("broken.npy", "broken.ply", "broken.las"):
        (tmp_path / name).write_bytes(b"junk" * 20)
    assert run_app(["evaluate", str(one_trial(tmp_path, "t", f'after = ["{after}"]'))]) == 2
    said = capsys.readouterr()
    assert complaint in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_bad_camera_files_and_loads(tmp_path: Path, capsys: Captured) -> None:
    np.save(tmp_path / "a.npy", np.ones((5, 8), np.uint16))
    trial = one_trial(tmp_path, "t", 'after = ["a.npy"]')
    for text, complaint in (
        (None, "the camera file of a.npy is not there. Put the frame set's camera.json beside it"),
        ("{", "cannot be read as JSON"),
        ("{}", "the block 'depth' is missing"),
        ('{"depth": {"width": 8, "height": 5, "fx": 0, "fy": 1, "cx": 1, "cy": 1}}', "depth.fx"),
    ):
        if text is not None:
            (tmp_path / "camera.json").write_text(text)
        assert run_app(["evaluate", str(trial)]) == 2
        assert complaint in capsys.readouterr().err
    for text, complaint in (
        ("t,load\n", "has no column 'load_n'"),
        ("load_n\nx\n", "csv:2: load_n"),
        ("load_n\n", "no finite loads"),
    ):
        (tmp_path / "l.csv").write_text(text)
        assert run_app(["evaluate", str(one_trial(tmp_path, "l", 'load_csv = "l.csv"'))]) == 2
        assert complaint in capsys.readouterr().err


def test_usage(tmp_path: Path, capsys: Captured) -> None:
    assert run_app(["evaluate"]) == 2
    assert "either an experiment file or --study" in capsys.readouterr().err
    assert run_app(["evaluate", str(tmp_path / "none.toml")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert run_app(["evaluate", "--study", "--save", "/proc/none"]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_without_scatter_there_is_no_test_of_a_difference(tmp_path: Path, capsys: Captured) -> None:
    path = tmp_path / "same.toml"
    trials = "".join(
        f"[[case.trial]]\nangle_deg = {angle}\nmeasured = {{ a_mm = 1.0 }}\n" for angle in (15, 15, 30, 30)
    )
    path.write_text(f'name = "x"\n[[case]]\nname = "a"\nwork = "scattering"\n{trials}')
    assert run_app(["evaluate", str(path), "--json", "--save", str(tmp_path / "out")]) == 0
    told = objects(capsys.readouterr().out)
    assert not [each for each in told if each["event"] == "difference_tested"]
    assert told[-1]["rows"][0]["low"] == told[-1]["rows"][0]["high"] == 1.0


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys: Captured) -> None:
    monkeypatch.setitem(__import__("sys").modules, "scipy.stats", None)
    assert run_app(["evaluate", "--study"]) == 2
    assert "Install graderd[evaluation]" in capsys.readouterr().err


def test_a_recording_holds_the_bed_before_and_after_and_gives_what_pictures_give(
    folder: Path, tmp_path: Path, capsys: Captured
) -> None:
    """Three pictures a second of the bed before, and from the fourth second on after the pass."""
    file = RecordingFile(tmp_path / "pass.mcap", {"version": "t"}, Config().model_dump_json().encode())
    states = [camera(0).scans_mm(heap(trapezoid(0.0, 200.0, 600.0, 120.0), -200.0, 200.0, 60.0), 3)]
    states.append(camera(1).scans_mm(layer(46.0), 3))
    for state, scans in enumerate(states):
        for number, depth in enumerate(scans):
            at_s = 100.0 + 4.0 * state + number / 3.0
            frame = Frame(np.zeros((2, 2, 3), np.uint8), depth, None, HALF_VIEW, at_s)
            seen = SoilObservation(at_s, Zone.UNKNOWN, 0.0, "")
            for message in messages_of(Judged(frame, 0.0, 0.0, UNMEASURED, at_s, seen), 1, 0):
                file.add(message)
    file.finish()
    lines = """name = "pass"
[[case]]
name = "Flattening work"
work = "flattening"
target_height_mm = 50.0
[[case.trial]]
angle_deg = 15
before = ["pass.mcap@0..2"]
after = ["pass.mcap@4..9.5"]
"""
    (tmp_path / "pass.toml").write_text(lines)
    found = evaluated(tmp_path / "pass.toml", capsys)
    pictures = lines.replace("pass.mcap@0..2", "flat-15-1-before-*.png").replace(
        "pass.mcap@4..9.5", "flat-15-1-after-*.png"
    )
    (folder / "pictures.toml").write_text(pictures)
    assert evaluated(folder / "pictures.toml", capsys) == found
    assert found["Flattening work", 15.0, "volume_moved_l"]["value"] > 1.0


@pytest.mark.parametrize(
    ("key", "value"),
    [("width", 10**9), ("scale_m", 1e300), ("cx", float("nan")), ("fx", 0.0), ("height", "many")],
)
def test_a_camera_that_cannot_be_is_one_line(tmp_path: Path, capsys: Captured, key: str, value: object) -> None:
    """A picture of 10^18 pixels was waited for, and metres of 10^300 were warned of."""
    save(tmp_path, "heap", [], HALF_VIEW)
    np.save(tmp_path / "scan.npy", np.ones((240, 848), np.uint16))
    told = json.loads((tmp_path / "camera.json").read_text(encoding="utf-8"))
    told["depth"][key] = value
    (tmp_path / "camera.json").write_text(json.dumps(told), encoding="utf-8")
    assert run_app(["evaluate", str(one_trial(tmp_path, "t", 'after = ["scan.npy"]'))]) == 2
    said = capsys.readouterr().err
    assert f"camera.json: depth.{key}: " in said
    assert said.count("\n") == 1


def test_a_load_that_is_no_table_is_one_line(tmp_path: Path, capsys: Captured) -> None:
    (tmp_path / "long.csv").write_text('load_n\n"' + "1" * 200_000 + '"\n', encoding="utf-8")
    assert run_app(["evaluate", str(one_trial(tmp_path, "t", 'load_csv = "long.csv"'))]) == 2
    assert "long.csv:1: load_n: field larger" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("pass.mcap@4..2", "'4..2' is no part of a recording"),
        ("pass.mcap@now", "'now' is no part of a recording"),
        ("pass.mcap@50..60", "no recording of graderd's"),
    ],
)
def test_a_wrong_part_of_a_recording_is_told_in_a_line(tmp_path: Path, capsys: Captured, name: str, words: str) -> None:
    (tmp_path / "pass.mcap").write_bytes(b"nothing")
    assert run_app(["evaluate", str(one_trial(tmp_path, "x", f'after = ["{name}"]'))]) == 2
    assert words in capsys.readouterr().err
