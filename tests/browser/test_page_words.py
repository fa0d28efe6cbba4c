"""The daemon's words on a Korean page: its sentences in Korean, and whatever is not known as it was said."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from graderd.tokens import Right
from tests.browser.conftest import Cab, shot
from tests.browser.test_page import CUT

pytestmark = pytest.mark.whole_machine
KOREAN: dict[str, str] = json.loads((Path(str(files("graderd.web"))) / "korean.json").read_text("utf-8"))
SAY = """async (texts) => {
    const { Words } = await import('/page/words.js');
    const words = new Words(await (await fetch('/page/korean.json')).json());
    return texts.map((text) => words.in(text));
}"""


def said(page: Page, *texts: str) -> list[str]:
    found: list[str] = page.evaluate(SAY, list(texts))
    return found


def test_every_sentence_is_found_with_what_is_put_in(cab: Cab) -> None:
    page = cab.page(None)
    put_in = ("7.5", "X", "13", "Q", "88", "Z")
    english = [text.format(*put_in) for text in KOREAN]
    assert said(page, *english) == [text.format(*put_in) for text in KOREAN.values()]


def test_sentences_in_sentences_are_found_too_and_nothing_is_lost(cab: Cab) -> None:
    page = cab.page(None)
    for english, korean in {
        "left 4.3, center 1.1, right 0.0 l: most of it left": "왼쪽 4.3, 가운데 1.1, 오른쪽 0.0 l: 가장 많은 곳은 왼쪽",
        "stopped: stop command (by cab)": "정지됨: 정지 명령 (cab)",
        "not ready: rotation: failed: no answer; lift_left position: no fresh measurement": (
            "준비되지 않음: 회전: 실패: no answer; 왼쪽 리프트 위치: 최신 측정값이 없습니다"
        ),
        "check power, cable and the [rotation] section": "전원, 케이블, 설정의 [rotation] 부분을 확인하십시오",
        # A remedy that has a list's separator in itself, in a list.
        "wait for the device, or check it; free the blade, look at current_limit_a; then arm; graderd reset": (
            "장치를 기다리거나 확인하십시오; "
            "블레이드에 걸린 것을 풀고 current_limit_a를 보십시오. 그다음 작동 준비를 하십시오; "
            "정지를 해제하십시오 (graderd reset)"
        ),
        "lift_left was held: lift_left.no_feedback: an actuator is not heard on the bus": (
            "왼쪽 리프트 유지됨: lift_left.no_feedback: 버스에서 액추에이터의 신호가 들리지 않습니다"
        ),
        "somebody saw a dog; it ran away": "somebody saw a dog; it ran away",
        "": "",
    }.items():
        assert said(page, english) == [korean]


def test_a_strangers_text_does_not_keep_the_page_busy(cab: Cab) -> None:
    page = cab.page(None)
    hard = [" to ".join(["x would go"] * 60), "; ".join(["a, b: c"] * 60), ": ".join("ab" * 60), "; also: a" * 60]
    looked_n = page.evaluate(
        """async (texts) => {
            const { Words } = await import('/page/words.js');
            let looked_n = 0;
            class Counted extends Words { known(text) { looked_n += 1; return super.known(text); } }
            const words = new Counted(await (await fetch('/page/korean.json')).json());
            for (const text of texts) words.in(text);
            return looked_n;
        }""",
        hard,
    )
    assert len(hard) <= looked_n < 5000


@pytest.mark.parametrize("width", [360, 1280])
def test_faults_readiness_refusals_and_reasons_are_korean(cab: Cab, width: int) -> None:
    page = cab.page(viewport={"width": width, "height": 800}, locale="ko-KR")
    cab.rig("camera_fault", name="unplug")
    cab.until(lambda s: any(f["name"] == "camera.missing" for f in s["faults"]), "fault")
    page.click("#tab-health")
    fault = next(f for f in cab.status()["faults"] if f["name"] == "camera.missing")
    for english in (fault["reads"], fault["remedy"]):
        expect(page.locator("#faults")).to_contain_text(KOREAN[english])
        expect(page.locator("#alarm")).to_contain_text(KOREAN[english])
    detail = page.locator("#faults small", has_text="rig camera at").first
    expect(detail).to_have_attribute("lang", "en")
    assert page.evaluate(CUT) == []
    shot(page, f"health-fault-ko-{width}")
    cab.rig("clear_faults")

    cab.client.command("stop", reason="stop command")
    expect(page.locator("[data-v=reason]")).to_have_text(re.compile("정지 명령"))
    expect(page.locator("#readiness")).to_contain_text(re.compile("정지됨: 정지 명령"))
    expect(page.locator("#readiness")).to_contain_text(KOREAN["graderd reset"])
    expect(page.locator("[data-v=last_stop]")).to_have_text(re.compile("정지 명령"))
    shot(page, f"health-stopped-ko-{width}")
    page.click("#tab-move")
    page.click("[data-command=reset]")
    expect(page.locator("#said")).to_have_text(KOREAN["reset; arm when the area around the blade is clear"])
    shot(page, f"move-said-ko-{width}")
    assert not page.locator("[data-v=reason]").get_attribute("lang")


def test_a_refusal_is_korean(cab: Cab) -> None:
    page = cab.page(locale="ko-KR")
    page.click("#tab-move")
    cab.rig("servo_fault", name="unplug")
    cab.until(lambda s: not all(r["met"] for r in s["readiness"] if r["name"] == "rotation position"), "not ready")
    page.click("[data-command=arm]")
    expect(page.locator("#said")).to_have_text(re.compile("^준비되지 않음: 회전: .*회전 위치: 최신 측정값이 없습니다"))
    expect(page.locator("#said")).to_have_text(re.compile(re.escape(KOREAN["wait for the device, or check it"])))
    shot(page, "move-refused-ko")


def test_without_its_catalogue_the_page_is_korean_and_the_daemon_english_until_it_comes(cab: Cab) -> None:
    made = cab.browser.new_context(viewport={"width": 1280, "height": 800}, locale="ko-KR")
    page = made.new_page()
    page.problems = []
    page.route("**/korean.json", lambda route: route.abort())
    page.goto(f"{cab.url}/#{cab.tokens[Right.COMMAND]}")
    page.wait_for_selector("#work:not([hidden])")
    expect(page.locator("[data-v=reason]")).to_have_text(re.compile("[a-z]"))
    expect(page.locator("[data-v=reason]")).to_have_attribute("lang", "en")
    page.unroute("**/korean.json")
    expect(page.locator("[data-v=reason]")).to_have_text(re.compile("^[^a-z]+$"))
    assert page.locator("[data-v=reason]").get_attribute("lang") is None
