"""The operator page in a browser, against the simulated grader and a daemon: what it shows, moves, and never moves."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import CDPSession, Page, Route, expect

from graderd.tokens import Right
from tests.browser.conftest import Cab, shot

pytestmark = pytest.mark.whole_machine
VIEWS = ("work", "move", "health", "plots")
PAGE_BYTES = 300_000
SHOWN_NUMBERS = """[...document.querySelectorAll('[data-v], #jogs output')].map((e) => e.textContent)
    .filter((text) => /\\d/.test(text) && text !== document.querySelector('[data-v=version]').textContent)"""

CUT = """[...document.querySelectorAll('button, th, td, dd, dt, h2, label, #mode, #heard')]
    .filter((e) => e.offsetParent && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== 'inline')
    .map((e) => e.outerHTML.slice(0, 120))"""
CUT_DRAWN = """new Promise((told) => {
    const real = CanvasRenderingContext2D.prototype.fillText, cut = new Set();
    CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        const { a, e } = this.getTransform(), box = this.measureText(text);
        const left = (x - box.actualBoundingBoxLeft) * a + e, right = (x + box.actualBoundingBoxRight) * a + e;
        if (left < -0.5 || right > this.canvas.width + 0.5) cut.add(`${this.canvas.id}: ${text}`);
        real.call(this, text, x, y);
    };
    setTimeout(() => { CanvasRenderingContext2D.prototype.fillText = real; told([...cut]); }, 400);
})"""
"""Words that are drawn over the edge of their picture, within some frames."""
AGES = """new Promise((told) => {
    const said = document.getElementById('picture-age'), ages_s = [];
    const looking = setInterval(() => ages_s.push(Number(/[\\d.]+/.exec(said.textContent)[0])), 100);
    setTimeout(() => { clearInterval(looking); told(ages_s); }, 5000);
})"""
"""The picture's age as it is told, through five seconds."""
PROFILE = """(() => {
    const { data } = document.getElementById('profile').getContext('2d').getImageData(0, 0, 10000, 10000);
    const kinds = { '10,107,44': 0, '11,79,158': 1, '168,50,10': 2 }, found = [0, 0, 0];
    for (let i = 0; i < data.length; i += 4) {
        const kind = kinds[`${data[i]},${data[i + 1]},${data[i + 2]}`];
        if (kind !== undefined) found[kind]++;
    }
    return found;
})()"""
"""How many pixels of the profile have the colour of the left, the center, the right third."""
SMALL = """[...document.querySelectorAll('button')].filter((e) => e.offsetParent)
    .map((e) => [e.id || e.textContent, e.offsetWidth, e.offsetHeight]).filter(([, w, h]) => w < 56 || h < 56)"""


def centre(page: Page, selector: str) -> tuple[float, float]:
    page.locator(selector).scroll_into_view_if_needed()
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def at_hand(cab: Cab, **context: Any) -> Page:
    """A page on the view for moving, of a machine in manual mode."""
    page = cab.page(**context)
    page.click("#tab-move")
    for _ in range(5):  # on a machine too busy for the simulated devices it may disarm again
        cab.manual()
        try:
            expect(page.locator("#jog-rotate\\+")).to_be_enabled(timeout=3000)
            return page
        except AssertionError:
            cab.calm()
    raise AssertionError(f"not in manual mode for long: {cab.status()}")


def hold(page: Page, selector: str) -> None:
    page.mouse.move(*centre(page, selector))
    page.mouse.down()


def inward(cab: Cab) -> str:
    """The button that turns the blade towards its middle: there is way to go."""
    return "#jog-rotate-" if cab.measured() > 0 else "#jog-rotate\\+"


def moving(cab: Cab, press: Callable[[], object], let_go: Callable[[], object]) -> None:
    """Press until it moves: a page that was not heard for half a second, on a busy machine, does not begin to."""
    for _ in range(5):
        before = cab.measured()
        press()
        end_s = time.monotonic() + 3
        while time.monotonic() < end_s:
            status = cab.status()
            if status["lease"] is not None and abs((status["axes"]["rotation"]["measured"] or before) - before) > 1.0:
                return
        let_go()
        if cab.status()["mode"] != "manual":
            cab.calm()
            cab.manual()
    raise AssertionError(f"does not move: {cab.status()}")


def hold_till_it_moves(cab: Cab, page: Page) -> None:
    button = inward(cab)
    moving(cab, lambda: hold(page, button), page.mouse.up)


def held_still(cab: Cab, page: Page) -> None:
    """Nobody holds the lease, and the blade stands."""
    cab.until(lambda s: s["lease"] is None, "lease given back")
    cab.until(lambda s: not s["axes"]["rotation"]["moving"], "at rest")
    there = cab.measured()
    page.wait_for_timeout(400)
    assert cab.status()["lease"] is None
    assert abs(cab.measured() - there) < 0.3


# ---- what it shows -------------------------------------------------------------------------------------------------


def test_a_decision_changes_in_sight(cab: Cab) -> None:
    cab.rig("scene", zone="left")
    cab.manual()
    page = cab.page()
    page.click("#tab-move")
    page.click("[data-command=auto]")
    page.click("#tab-work")
    expect(page.locator("[data-v=decision]")).to_have_text("LEFT → 30.0°")
    expect(page.locator("#mode strong")).to_have_text("AUTOMATIC · SIMULATED")
    cab.until(lambda s: s["axes"]["rotation"]["arrived"], "turned")
    left_n, _, right_n = page.evaluate(PROFILE)
    assert left_n > 20 * right_n + 500, "the soil lies left"
    page.uncheck("#mirror")  # that turns the picture alone
    page.wait_for_timeout(300)
    left_n, _, right_n = page.evaluate(PROFILE)
    assert left_n > 20 * right_n + 500
    page.check("#mirror")
    shot(page, "work-left")
    cab.rig("scene", zone="right")
    expect(page.locator("[data-v=decision]")).to_have_text("RIGHT → −30.0°")
    expect(page.locator("[data-v=requested]")).to_have_text("−30.0°")
    cab.until(lambda s: s["axes"]["rotation"]["arrived"], "turned back")
    expect(page.locator("[data-v=measured]")).to_have_text(re.compile("−(29|30)"))
    cab.rig("scene", zone="right")  # the turning blade has moved the first
    expect(page.locator("[data-v=zone]")).to_have_text("RIGHT")
    assert float(page.locator("[data-v=ahead_right]").inner_text()) > 3.0
    shot(page, "work-right")


def test_a_camera_that_is_unplugged_is_told_with_its_remedy_and_its_picture_goes_grey(cab: Cab) -> None:
    page = cab.page()
    expect(page.locator("#picture:not([data-old])")).to_be_visible()
    cab.rig("camera_fault", name="unplug")
    expect(page.locator("#picture[data-old]")).to_be_visible()
    expect(page.locator("#picture-age")).to_have_text(re.compile(r"OLD PICTURE: \d+\.\d s"))
    cab.until(lambda s: any(f["name"].startswith("camera.") for f in s["faults"]), "fault")
    expect(page.locator("[data-v=zone]")).to_have_text("NOT SURE")
    expect(page.locator("[data-v=ahead_left]")).to_have_text("–")
    page.click("#tab-health")
    fault = next(f for f in cab.status()["faults"] if f["name"].startswith("camera."))
    expect(page.locator("#faults")).to_contain_text(fault["reads"])
    expect(page.locator("#faults")).to_contain_text(fault["remedy"])
    shot(page, "camera-unplugged")
    cab.rig("clear_faults")
    page.click("#tab-work")
    expect(page.locator("#picture:not([data-old])")).to_be_visible(timeout=20_000)


def test_a_picture_that_lay_on_its_way_is_as_old_as_that(cab: Cab) -> None:
    """A link that hands it over late says nothing of it: its age counts the way."""
    page = cab.page()
    expect(page.locator("#picture:not([data-old])")).to_be_visible()

    def late(route: Route) -> None:
        answer = route.fetch()
        time.sleep(1.2)
        route.fulfill(response=answer)

    page.route("**/v1/preview.jpg*", late)
    expect(page.locator("#picture[data-old]")).to_be_visible()
    ages_s = page.evaluate(AGES)
    page.unroute_all(behavior="ignoreErrors")
    assert min(ages_s) > 1.0, "never told as new"
    assert min(after_s - before_s for before_s, after_s in pairwise(ages_s)) < -0.5, "newer ones came"
    expect(page.locator("#picture:not([data-old])")).to_be_visible()


def test_what_is_not_heard_is_not_shown(cab: Cab) -> None:
    page = cab.page()
    expect(page.locator("[data-v=measured]")).to_have_text(re.compile(r"\d"))
    cab.wire.held.add("/v1/stream")
    page.wait_for_selector("body[data-stale]")
    expect(page.locator("#heard")).to_have_text(re.compile(r"last heard [1-9]\.\d s ago"))
    assert page.evaluate(SHOWN_NUMBERS) == []
    assert (
        page.evaluate(
            "[...document.querySelectorAll('#faults-n, #faults, #readiness')].map((e) => e.textContent).join('')"
        )
        == ""
    )
    assert page.evaluate("[...document.querySelectorAll('[data-command], #jogs button')].every((e) => e.disabled)")
    shot(page, "stale")
    cab.wire.held.clear()
    page.wait_for_selector("body:not([data-stale])")
    expect(page.locator("[data-v=measured]")).to_have_text(re.compile(r"\d"))


# ---- STOP ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("way", ["touch", "space"])
def test_stop_from_every_view(cab: Cab, view: str, way: str) -> None:
    cab.manual()
    page = cab.page()
    page.click(f"#tab-{view}")
    if way == "touch":
        page.tap("#stop button")
    else:
        page.keyboard.press("Space")
    cab.until(lambda s: s["mode"] == "stopped", "stopped")
    expect(page.locator("#stop-said")).to_have_text("Stopped.")
    expect(page.locator("#mode strong")).to_contain_text("STOPPED")
    assert cab.status()["reason"] == "STOP on the page (by page)"


def test_stop_while_the_stream_is_stale(cab: Cab) -> None:
    cab.manual()
    page = cab.page()
    cab.wire.held.update({"/v1/stream", "/v1/preview"})
    page.wait_for_selector("body[data-stale]")
    page.tap("#stop button")
    cab.until(lambda s: s["mode"] == "stopped", "stopped")
    expect(page.locator("#stop-said")).to_have_text("Stopped.")
    shot(page, "stopped-while-stale")


def test_stop_before_anything_else_has_loaded(cab: Cab) -> None:
    context = cab.page().context
    cab.manual()
    page = context.new_page()
    page.problems = []
    page.route("**/page/*", lambda route: route.abort())
    page.goto(cab.url)
    page.tap("#stop button")
    cab.until(lambda s: s["mode"] == "stopped", "stopped")
    cab.calm()
    without = cab.browser.new_context(java_script_enabled=False, storage_state=context.storage_state())
    page = without.new_page()
    page.problems = []
    page.goto(cab.url)
    page.click("#stop button")
    cab.until(lambda s: s["mode"] == "stopped", "stopped without any script")


def test_a_stop_that_nobody_hears_says_so_and_is_asked_for_until_it_is_heard(cab: Cab) -> None:
    cab.manual()
    page = cab.page()
    cab.wire.held.add("/")
    page.wait_for_selector("body[data-stale]")
    page.tap("#stop button")
    expect(page.locator("#stop-said")).to_have_text("NO ANSWER: use the emergency stop")
    assert cab.status()["mode"] == "manual"
    cab.wire.held.clear()
    cab.until(lambda s: s["mode"] == "stopped", "stopped once it was heard")


# ---- moving by hand ------------------------------------------------------------------------------------------------


def test_it_moves_while_held_and_holds_when_let_go(cab: Cab) -> None:
    page = at_hand(cab)
    hold_till_it_moves(cab, page)
    assert cab.status()["lease"]["client"].startswith("page@command#")
    expect(page.locator("[data-v=lease]")).to_contain_text("page@command#")
    shot(page, "moving")
    page.mouse.up()
    held_still(cab, page)


def test_the_other_way_and_the_lifts(cab: Cab) -> None:
    page = at_hand(cab)
    for button, way in (("#jog-height\\+", 1), ("#jog-height-", -1)):
        before = cab.measured("lift_left")
        for _ in range(5):
            hold(page, button)
            end_s = time.monotonic() + 3
            while time.monotonic() < end_s and way * (cab.measured("lift_left") - before) < 5:
                pass
            page.mouse.up()
        cab.until(lambda s: s["lease"] is None, "lease given back")
        assert way * (cab.measured("lift_left") - before) > 5
    held_still(cab, page)


def test_enter_held_on_a_button_moves_too(cab: Cab) -> None:
    page = at_hand(cab)
    page.focus(inward(cab))
    moving(cab, lambda: page.keyboard.down("Enter"), lambda: page.keyboard.up("Enter"))
    page.keyboard.up("Enter")
    held_still(cab, page)


ENDS = ("blur", "hidden", "freeze", "pagehide", "second touch", "pointercancel", "another key", "view", "leave")


@pytest.mark.parametrize("how", ENDS)
def test_whatever_takes_the_hand_away_ends_it(cab: Cab, how: str) -> None:
    page = at_hand(cab)
    cdp = page.context.new_cdp_session(page)
    if how in ("second touch", "pointercancel"):
        x, y = centre(page, inward(cab))
        moving(cab, lambda: touch(cdp, "touchStart", (x, y)), lambda: touch(cdp, "touchEnd"))
    else:
        hold_till_it_moves(cab, page)
    if how == "blur":
        page.evaluate("window.dispatchEvent(new Event('blur'))")
    elif how == "hidden":
        page.evaluate(
            "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
    elif how == "freeze":
        # Told as the browser tells it. Newer ones freeze no page that is in sight, whatever a debugger says.
        page.evaluate("document.dispatchEvent(new Event('freeze'))")
    elif how == "pagehide":
        page.evaluate("window.dispatchEvent(new Event('pagehide'))")
    elif how == "second touch":
        touch(cdp, "touchStart", (x, y), (x + 300, y + 5))
    elif how == "pointercancel":
        touch(cdp, "touchCancel")
    elif how == "another key":
        page.keyboard.press("Tab")
    elif how == "view":
        page.evaluate("document.getElementById('tab-work').click()")
    else:
        page.goto("about:blank")
    cab.until(lambda s: s["lease"] is None, "lease given back")
    held_still(cab, page)


def touch(cdp: CDPSession, kind: str, *points: tuple[float, float]) -> None:
    at = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    cdp.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})


@pytest.mark.parametrize("how", ["dropped", "silent", "stream silent", "renewals silent"])
def test_a_connection_lost_in_mid_jog_ends_it(cab: Cab, how: str) -> None:
    page = at_hand(cab)
    hold_till_it_moves(cab, page)
    lost_s = time.monotonic()
    if how == "dropped":
        cab.wire.drop("/v1/jog")
    else:
        cab.wire.held.add({"silent": "/", "stream silent": "/v1/stream", "renewals silent": "/v1/jog"}[how])
    cab.until(lambda s: s["lease"] is None, "lease over")
    assert time.monotonic() - lost_s < 2.5
    cab.wire.held.clear()
    held_still(cab, page)
    assert page.locator("[data-held]").count() == 0


@pytest.mark.parametrize(("button", "axis", "end"), [("rotate\\+", "rotation", 59.95), ("pitch-", "tilt", 3.3)])
def test_held_long_enough_it_goes_to_the_end_of_its_travel_and_no_further(
    cab: Cab, button: str, axis: str, end: float
) -> None:
    page = at_hand(cab)
    hold(page, f"#jog-{button}")
    cab.until(lambda s: abs((s["axes"][axis]["measured"] or 0.0) - end) < 1.6, "at its end")
    page.mouse.up()
    held_still(cab, page)


def test_a_lease_that_lapsed_is_not_taken_again_by_a_hand_that_did_not_move(cab: Cab) -> None:
    page = at_hand(cab)
    hold_till_it_moves(cab, page)
    cab.wire.held.add("/v1/jog")
    cab.until(lambda s: s["lease"] is None, "lapsed")
    cab.wire.held.clear()
    held_still(cab, page)


def test_beside_somebody_elses_lease_the_page_names_it_and_moves_nothing(cab: Cab) -> None:
    page = at_hand(cab)
    words = ("jog", "rotate", "-25deg" if cab.measured() > 0 else "+25deg", "--hold-s", "8")
    command = [sys.executable, "-m", "graderd", "--socket", str(cab.directory / "graderd.sock"), *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as other:
        try:
            holder = cab.until(lambda s: s["lease"] is not None, "the other's lease")["lease"]["client"]
            expect(page.locator("[data-v=lease]")).to_contain_text(holder)
            hold(page, "#jog-height\\+")
            before_mm = cab.measured("lift_left")
            page.wait_for_timeout(700)
            status = cab.status()
            assert status["lease"] is not None
            assert status["lease"]["client"] == holder
            assert abs(cab.measured("lift_left") - before_mm) < 1.0
            expect(page.locator("#said")).not_to_be_empty()
            page.mouse.up()
        finally:
            other.terminate()
    cab.until(lambda s: s["lease"] is None, "the lease given back")


def test_nothing_moves_by_back_refresh_or_autofill(cab: Cab) -> None:
    page = at_hand(cab)
    hold_till_it_moves(cab, page)
    page.reload()
    page.mouse.up()
    held_still(cab, page)
    page.click("#tab-move")
    page.goto("about:blank")
    page.go_back()
    page.wait_for_selector("body:not([data-stale])")
    held_still(cab, page)
    assert cab.status()["mode"] == "manual"
    assert page.locator("input[type=password]").get_attribute("autocomplete") == "off"
    assert page.evaluate("document.querySelector('#jog-rotate\\\\+').click()") is None
    page.evaluate("document.querySelector('[data-command=disarm]').click()")
    page.wait_for_timeout(300)
    assert cab.status()["mode"] == "manual", "a click that no hand made"


# ---- rights --------------------------------------------------------------------------------------------------------


def test_who_may_only_read_sees_all_moves_nothing_and_may_stop(cab: Cab) -> None:
    cab.manual()
    page = cab.page(Right.READ)
    expect(page.locator("#who")).to_have_text("looks on; may stop")
    page.click("#tab-move")
    everything = "[...document.querySelectorAll('[data-command], #jogs button, #presets button')]"
    assert page.evaluate(f"{everything}.every((e) => e.disabled)")
    page.tap("#stop button")
    cab.until(lambda s: s["mode"] == "stopped", "stopped")


def test_a_stranger_is_asked_for_a_token_once(cab: Cab) -> None:
    page = cab.page(None)
    expect(page.locator("#login")).to_be_visible()
    expect(page.locator("#work")).to_be_hidden()
    page.fill("#token", "wrong")
    page.click("#login-form button")
    expect(page.locator("#login-said")).to_have_text("This token is not one of the machine's.")
    shot(page, "login")
    page.fill("#token", cab.tokens[Right.READ])
    page.click("#login-form button")
    expect(page.locator("#work")).to_be_visible()
    page.reload()
    expect(page.locator("#work")).to_be_visible()
    assert cab.tokens[Right.READ] not in page.content()
    assert page.evaluate("document.cookie") == ""
    assert page.evaluate("location.hash") == ""


# ---- form ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("language", ["en", "ko"])
@pytest.mark.parametrize("width", [360, 800, 1280])
def test_no_violation_of_axe_and_no_word_cut(cab: Cab, language: str, width: int) -> None:
    cab.manual()
    page = cab.page(viewport={"width": width, "height": 800}, locale="ko-KR" if language == "ko" else "en-GB")
    assert page.evaluate("document.documentElement.lang") == language
    expect(page.locator("#picture:not([data-old])")).to_be_visible()
    for view in VIEWS:
        page.click(f"#tab-{view}")
        page.wait_for_timeout(300)
        found = Axe().run(page)
        assert found.violations_count == 0, found.generate_report()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{view} is wider than the page"
        cut = page.evaluate(CUT)
        assert cut == []
        assert page.evaluate(CUT_DRAWN) == [], f"{view} has words that go over the edge of their picture"
        assert page.evaluate("getComputedStyle(document.body).wordBreak") == "keep-all"
        small = page.evaluate(SMALL)
        assert small == [], "too small for a glove"
        shot(page, f"{view}-{language}-{width}")


def test_the_page_is_light(cab: Cab) -> None:
    page = cab.page(None, locale="ko-KR")  # which needs one file more
    sizes: dict[str, int] = {}
    page.on("response", lambda answer: sizes.update({answer.url: len(answer.body())}))
    page.reload(wait_until="networkidle")
    sizes = {url: size_n for url, size_n in sizes.items() if "/v1/" not in url}
    sys.stdout.write(f"page weight: {sum(sizes.values())} bytes in {len(sizes)} files\n")
    assert any(url.endswith("korean.json") for url in sizes)
    assert sum(sizes.values()) < PAGE_BYTES
    assert all(url.startswith(cab.url) for url in sizes)


def test_by_keyboard_alone(cab: Cab) -> None:
    cab.until(lambda s: all(r["met"] for r in s["readiness"] if r["mandatory"]), "ready")
    page = cab.page()
    page.focus("#tab-work")
    page.keyboard.press("ArrowRight")
    expect(page.locator("#move")).to_be_visible()
    for _ in range(6):
        if page.evaluate("document.activeElement.dataset.command") == "arm":
            break
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    cab.until(lambda s: s["mode"] == "manual", "armed by keyboard")
