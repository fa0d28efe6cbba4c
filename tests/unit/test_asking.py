"""Questions and who answers them: a person, a file by keys, or nobody; a consent is a clear yes, each time."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer

from graderd.cli.asking import Answers, agree, answered_by, ask, choice, one_of
from graderd.cli.console import CliError
from graderd.cli.setup import QUESTIONS, sources_of
from graderd.commissioning import Commissioning, RecordError

PLACES = {f"rotation.{name}" for name in ("square", "aside", "left_back", "right_back")}
"""Their keys are put together."""


def given(*lines: str) -> Answers:
    return Answers(lines, "answers.txt")


def test_a_file_answers_by_key_and_a_default_where_it_does_not() -> None:
    with answered_by(given("# mine", "", "side = LEFT", "port = 2")):
        assert ask("side", "Which side", one_of("left", "right")) == "left"
        assert ask("port", "Which port", choice(["/dev/a", "/dev/b"])) == "/dev/b"
        assert ask("other", "Which", one_of("x", "y"), "y") == "y"
        with pytest.raises(CliError, match=r"answers\.txt") as refused:
            ask("none", "Which", one_of("x"))
        assert refused.value.where == "none"


def test_a_consent_is_a_clear_yes_and_counts_once() -> None:
    with answered_by(given("go = yes", "go = y", "maybe = perhaps")):
        agree("go", "Go?")
        agree("go", "Go?")
        for key in ("go", "maybe", "never asked before"):
            with pytest.raises(CliError, match="cancelled; nothing was changed"):
                agree(key, "Go?")


def test_a_line_that_is_none_is_refused_by_its_number() -> None:
    with pytest.raises(CliError, match="line 2 is not KEY = ANSWER"):
        given("a = 1", "yes")


@pytest.mark.parametrize("interrupted", [True, False])
def test_ctrl_c_at_a_question_is_ctrl_c_and_the_end_of_input_is_not(
    interrupted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def abort(*_: object, **__: object) -> None:
        try:
            raise KeyboardInterrupt if interrupted else EOFError
        except (KeyboardInterrupt, EOFError):
            raise typer.Abort from None

    monkeypatch.setattr(typer, "prompt", abort)
    monkeypatch.setattr(typer, "confirm", abort)
    for call in (lambda: ask("a", "A", str), lambda: agree("a", "A")):
        with pytest.raises(KeyboardInterrupt if interrupted else CliError):
            call()


def test_setup_lists_every_question_it_asks() -> None:
    """A file can answer each: every key in the code of the talks stands in the list, and none that is not asked."""
    cli = Path(__file__).parents[2] / "graderd" / "cli"
    names = ("setup", "stop_tests", "calibrate", "calibrate_lifts", "calibrate_rotation")
    code = "".join((cli / f"{name}.py").read_text() for name in names)
    asked = set(re.findall(r'(?:ask|agree|agreed|_agree|_wanted|_one)\(\s*"([a-z_.]+)"', code))
    listed = {key for keys, _ in QUESTIONS for key in keys.split(", ")}
    assert asked - listed == set()
    assert listed - asked <= {"servo.port", "lift_left.address", "lift_right.address", "tilt.address", *PLACES}


def test_who_is_heard_on_a_bus() -> None:
    lines = "(1.0) can0 18FF5013#0102\n# 3 lines lost\n(1.1) can0 18EFE714#00\n(1.2) can0 123#00\n"
    assert sources_of(lines) == {0x13, 0x14}


CONFIG = {"rotation": {"port": "/dev/a", "zero_deg": 1.0}, "tilt": {"address_n": 27}}


def test_a_step_holds_while_what_it_rests_on_does(tmp_path: Path) -> None:
    record = Commissioning(tmp_path / "c.json")
    record.done("servo", CONFIG, ("rotation.port",), {"baud_n": 57600})
    record = Commissioning(tmp_path / "c.json")
    assert record.is_done("servo", CONFIG)
    assert not record.is_done("lifts", CONFIG)
    assert record.is_done("servo", {**CONFIG, "tilt": {}}), "nothing of it"
    assert not record.is_done("servo", {"rotation": {"port": "/dev/b"}})


def test_a_signature_says_whether_it_was_changed(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    record = Commissioning(path)
    record.done("servo", CONFIG, ("rotation.port",), {"further_deg": 1.25})
    record.sign("Kim", "ab" * 32)
    assert Commissioning(path).is_as_signed()
    path.write_text(path.read_text().replace("1.25", "0.25"))
    assert not Commissioning(path).is_as_signed()
    record.done("lifts", CONFIG, (), {})
    assert Commissioning(path).signature is None, "what was signed was another record"


def test_what_is_no_record_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text("[1]")
    with pytest.raises(RecordError, match="is no commissioning record"):
        Commissioning(path)
