"""The DBC of the whole machine, as other tools see it: every frame by its identifier alone, for all three actuators."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cantools.database
import pytest
from cantools.database.can import Database

from graderd.config import Config
from graderd.drivers.electrak.codec import Control, ElectrakCodec, Feedback
from graderd.drivers.j1939.ids import Pgn, make_id
from graderd.runtime.app.can_database import main

ACTUATORS = {"lift_left": (19, "electrak_hd"), "lift_right": (20, "electrak_hd"), "tilt": (27, "electrak_md")}


@pytest.fixture(params=["dbc", "kcd"])
def database(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> Database:
    assert main(["--kcd"] if request.param == "kcd" else []) == 0
    found = cantools.database.load_string(capsys.readouterr().out, database_format=request.param, strict=True)
    assert isinstance(found, Database)
    return found


@pytest.mark.parametrize("name", ACTUATORS)
def test_each_actuators_frames_are_decoded_by_their_identifier_as_our_codec_does(name: str, database: Database) -> None:
    address, layout = ACTUATORS[name]
    codec = ElectrakCodec(layout)
    acm: Any = database.decode_message(
        make_id(6, Pgn.PROPRIETARY_A, Config().can.source_address_n, address),
        codec.encode_control(Control(50.0, 5.0, 80.0, motion_enable=True)),
    )
    assert (acm["target_position_mm"], acm["current_limit_a"], acm["motion_enable"]) == (50.0, 5.0, 1)
    feedback = Feedback(42.5, 2.5, 50.0, True, frozenset({"overload", "voltage_low"}))
    afm: Any = database.decode_message(make_id(6, Pgn.PROPRIETARY_A2, address), codec.encode_feedback(feedback))
    assert (afm["position_mm"], afm["current_a"], afm["moving"], afm["overload"]) == (42.5, 2.5, 1, 1)
    assert str(afm["voltage_error"]) == "low"
    assert database.get_message_by_frame_id(make_id(6, Pgn.PROPRIETARY_A2, address)).name == f"AFM_{name}"
    assert database.get_message_by_name(f"AFM_{name}").is_extended_frame


def test_the_addresses_are_those_of_the_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "graderd.toml"
    path.write_text("version = 2\n[can]\nsource_address_n = 200\n[lift_right]\naddress_n = 22\n")
    assert main(["--config", str(path)]) == 0
    found = cantools.database.load_string(capsys.readouterr().out, database_format="dbc")
    assert isinstance(found, Database)
    assert found.get_message_by_name("ACM_lift_right").frame_id == make_id(6, Pgn.PROPRIETARY_A, 200, 22)
    path.write_text("not TOML")
    assert main(["--config", str(path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
