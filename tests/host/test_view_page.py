"""The page in a real browser, 1280 and 360 pixels wide: all drawn, nothing wider than the screen, buttons that ask."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from host.recordings.recording import RecordingFile
from host.run.commander import Commander
from host.view.live import LiveRig
from host.view.replay import Findings, Replay, Window
from host.view.server import ADDRESS, ViewServer
from tests.host.test_foxglove import recording  # noqa: F401 - a fixture
from tests.host.test_view import free_port, running
from tests.host.test_view_live import loopback
from tests.host.virtual_rig import VirtualRig
from tests.sim.test_home_run import rig_with_a_switch
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.browser
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SWITCHES = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDTHS = [(1280, 800), (360, 740)]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium: apt-get install chromium")
    with playwright.sync_playwright() as p:
        chromium = p.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield chromium
        chromium.close()


class OpenPage:
    """A page of `port`, and what its console complained of."""

    def __init__(self, browser: Any, port: int, size: tuple[int, int]) -> None:
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.complaints: list[str] = []
        self.page.on("console", lambda message: self._hear(message.type, message.text))
        self.page.on("pageerror", lambda error: setattr(self, "broken", str(error)))
        self.broken = ""
        self.page.set_default_timeout(1e3 * PATIENCE_S)
        self.page.goto(f"http://{ADDRESS}:{port}/")
        self.ready()

    def ready(self) -> None:
        self.wait(lambda: self.page.evaluate("Boolean(window.seldinger && seldinger.frames > 2 && seldinger.scene)"))

    def fresh(self, width: int = 1280, scheme: str = "dark") -> OpenPage:
        """Load the page again, so that a test inherits nothing of the one before."""
        self.look_as(width, scheme)
        self.page.evaluate("scrollTo(0, 0)")  # a browser scrolls a page that is loaded again to where it was
        self.page.reload()
        self.complaints.clear()
        self.ready()
        return self

    def look_as(self, width: int, scheme: str) -> None:
        self.page.set_viewport_size({"width": width, "height": dict(WIDTHS)[width]})
        self.page.emulate_media(color_scheme=scheme)

    def _hear(self, kind: str, text: str) -> None:
        # The software renderer complains of itself: reading pixels back is slow.
        if kind in ("error", "warning") and "GPU stall" not in text:
            self.complaints.append(text)

    def wait(self, happened: Callable[[], bool]) -> None:
        """Wait for `happened`; a script that has failed ends the wait at once."""
        until(lambda: bool(self.broken) or happened(), "the page")
        assert not self.broken

    def confirm(self, button: str) -> None:
        """Press a button that asks once more; from the first press on where it has waited too long for that."""
        self.page.locator(f'[data-button="{button}"]').evaluate(
            "b => { if (!b.classList.contains('asks')) b.click(); b.click(); }"
        )

    def text(self, selector: str) -> str:
        return str(self.page.inner_text(selector))

    def picture_of(self, selector: str) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(self.page.locator(selector).screenshot())).convert("RGB")).astype(int)

    def __enter__(self) -> OpenPage:
        return self

    def __exit__(self, *_: object) -> None:
        self.page.close()


def near(picture: np.ndarray, color: str) -> int:
    """How many pixels have about the hue of `color` (#rrggbb), whatever their brightness."""
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)], dtype=float)
    size = np.linalg.norm(picture, axis=-1)
    along = picture @ (wanted / np.linalg.norm(wanted)) / np.maximum(size, 1.0)
    return int(((along > 0.99) & (size > 120)).sum())


def test_a_recording_is_drawn_and_can_be_moved_about_in(browser: Any, recording: Path) -> None:  # noqa: F811
    findings = Findings(
        verdict="missing_physics",
        says=["Play of 3.1 mm in insertion."],
        windows=[Window(subsystem="insertion", condition="after reversals", span_s=(0.2, 0.4))],
    )
    with (
        running(ViewServer(Replay(RecordingFile(recording), findings=findings), port := free_port())),
        OpenPage(browser, port, WIDTHS[0]) as open_page,
    ):
        page = open_page.page
        open_page.wait(lambda: open_page.text("#play") == "Again")
        assert open_page.text("#mode") == "Contact" and open_page.text("#action") == "No fault"
        assert open_page.text("#force") == "0.200 N" and "Play of 3.1 mm" in page.text_content("#findings")
        mark = page.evaluate("[...document.querySelectorAll('#windows i')].map(i => [i.style.left, i.style.width])")
        assert [[round(float(part.rstrip("%"))) for part in one] for one in mark] == [[20, 20]]
        page.evaluate("seek.value = 0.5; seek.dispatchEvent(new Event('input'))")
        open_page.wait(lambda: open_page.text("#clock").startswith("0.5 of"))
        for width, _ in WIDTHS:
            open_page.look_as(width, "light")
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            open_page.wait(lambda: near(open_page.picture_of("#scene-card"), "#2563c9") > 300)  # the catheter
            scene = open_page.picture_of("#scene-card")
            page.evaluate("() => { seldinger.scene.wall.children[0].visible = false; seldinger.scene.render(); }")
            open_page.wait(
                lambda before=scene: bool((abs(open_page.picture_of("#scene-card") - before).max(axis=-1) > 20).sum() > 1000)
            )
            page.evaluate("() => { seldinger.scene.wall.children[0].visible = true; seldinger.scene.render(); }")
            open_page.wait(lambda: near(open_page.picture_of("#pose-card"), "#2563c9") > 30)  # the trace of the tip
        assert page.locator("#controls").is_hidden() and open_page.complaints == []


def past() -> dict[str, Any]:
    """Twenty seconds on a beating wall, for the traces to have something to draw."""
    now = time.monotonic()
    rows, estimates = [], []
    for back_s in np.arange(20.0, 0.0, -0.1).tolist():
        beat = math.sin(2.0 * math.pi * back_s)
        force_N = 0.2 + 0.03 * beat
        rows.append([now - back_s, force_N, 0.2, 0.0, -0.0107 + 0.0004 * beat, 0.025 + 0.001 * beat, 0.0, -0.0107, 0.025])
        estimates.append([now - back_s, force_N + 0.01, 0.02])
    lines = [("info", "commander", "view-1: arm: accepted"), ("warning", "safety", "retract: contact force above the limit")]
    log = [
        {"t": now - 3.0 + number, "level": level, "source": who, "text": text}
        for number, (level, who, text) in enumerate(lines)
    ]
    return {"rows": rows, "estimates": estimates, "log": log}


@dataclass
class State:
    """What the rig shows in one state, and the words that the page has to find for it."""

    mode: str
    action: str = "none"
    causes: list[str] = field(default_factory=list)
    first: dict[str, Any] | None = None
    force_N: float | None = 0.01
    body: bool = False
    plan: dict[str, Any] | None = None
    silent_s: float | None = 0.01
    says: tuple[str, str, str] = ("", "", "")  # safety, phase, a part of the cause

    def frame(self) -> dict[str, Any]:
        now, pressing = time.monotonic(), self.mode in ("approach", "contact", "retract")
        estimated = (self.force_N or 0.0) + 0.01
        model = {"scale": 1.02, "sd": 0.03, "adaptation": "frozen", "text": "in contact", "place": "tip", "sensors": 3}
        if self.body:
            text = "the tip presses with 0.02 N, the body with 0.31 N"
            model |= {"place": "body", "body_offset_m": 0.031, "body_offset_sd_m": 0.004, "contact_text": text}
        return {
            "t": now,
            "mode": self.mode,
            "action": self.action,
            "causes": self.causes,
            "first": self.first,
            "force_N": self.force_N,
            "target_force_N": 0.2 if self.mode == "contact" else None,
            "pose_age_ms": 20.0,
            "rejected": [0, 1],
            "rows": [[now, self.force_N, 0.2, 0.0, -0.0107, 0.025, 0.0, -0.0107, 0.025]],
            "estimates": [[now, estimated, 0.02]],
            "loop": dict.fromkeys(
                ("tick_p50_us", "tick_p99_us", "tick_p999_us", "tick_max_us", "lateness_p50_us", "lateness_p99_us"), 38.2
            )
            | {
                "loop_hz": 1000.0,
                "ticks": 81_500,
                "missed_ticks": 3,
                "lateness_p999_us": 61.0,
                "lateness_max_us": 1_742_511.0,
            }
            | {"longest_gap_ms": 31.2},
            "board": {
                "state": "fault" if self.first else "running",
                "fault": 1 if self.first else 0,
                "fault_name": "deadman",
            }
            | {"age_ms": 4.0, "queue_depth": 2, "deadman_age_ms": 1.0, "underruns": 0, "crc_errors": 0, "host_crc_errors": 0}
            | {"rejected": 0, "last_reject": "", "boot_count": 1},
            "model": model,
            "plan": self.plan,
            "silent_s": self.silent_s,
            "malformed": 0,
            "scene": {
                "shape": [[0, -0.0107 * (i / 14) ** 2, 0.025 * i / 14] for i in range(15)],
                "gap_m": 0.001,
                "tip": [0, -0.0107, 0.025],
                "force": [0, 0, self.force_N or 0.0],
                "estimate": [0, 0, estimated] if pressing else [],
                "target": [0, -0.0107, 0.025],
                "into": [0, 0, 1] if pressing else [],
                "poses": {"tip": [0, -0.0107, 0.025, 1, 0, 0, 0]},
            },
        }


STARVED = {
    "says": "The computer stood still: no set-point for 812 ms, the process was not scheduled.",
    "remedy": "End other programs, or isolate a core.",
    "followed": ["The board's dead man stopped the stages.", "No pose was fresh."],
}
STATES = {
    "disconnected": State("", silent_s=None, force_N=None, says=("No data yet", "–", "Check that it runs")),
    "disarmed": State("disarmed", says=("No fault", "Disarmed", "do not move until the rig is armed")),
    "hold": State("hold", says=("No fault", "Holding", "Armed and holding")),
    "homing": State("homing", says=("No fault", "Homing", "moves to its home switch")),
    "approach": State("approach", says=("No fault", "Approach", "No safety cause")),
    "contact": State("contact", force_N=0.21, says=("No fault", "Contact", "No safety cause")),
    "retract": State(
        "retract",
        "retract",
        ["contact force above the limit: retracting"],
        force_N=0.51,
        says=("Retracting", "Retract", "Contact force above the limit: retracting."),
    ),
    "stopped": State("stopped", "stop", ["board fault"], STARVED, says=("Stopped", "Stopped", "End other programs")),
    "body contact": State(
        "contact",
        "warn",
        ["the catheter touches away from the tip: the estimate is not the tip's force"],
        force_N=0.12,
        body=True,
        says=("Warning", "Contact", "touches away from the tip"),
    ),
}


class Fake:
    """A live rig that shows `State`s and notes what it is asked."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.state = STATES["retract"]
        self.result = "refused"
        self.waits_for: threading.Event | None = None

    def hello(self) -> dict[str, Any]:
        return {
            "kind": "live",
            "rig": "simulated",
            "catheter": "blazer_prime_xp",
            "over_force_N": 0.5,
            "radius_m": 0.0012,
            "homes": ["insertion"],
            "past": past(),
        }

    def frame(self) -> dict[str, Any]:
        return self.state.frame()

    def act(self, text: str) -> dict[str, Any]:
        self.asked.append(json.loads(text))
        if self.waits_for is not None:
            self.waits_for.wait(PATIENCE_S)
        return {"action": self.asked[-1]["button"], "result": self.result, "text": "no board"}


@pytest.fixture(scope="module")
def shown(browser: Any) -> Iterator[tuple[Fake, OpenPage]]:
    """One rig, one server and one page for all tests that need no rig of their own."""
    fake = Fake()
    with running(ViewServer(fake, port := free_port())), OpenPage(browser, port, WIDTHS[0]) as open_page:
        yield fake, open_page


@pytest.fixture
def rig(shown: tuple[Fake, OpenPage]) -> tuple[Fake, OpenPage]:
    """The same, as if they had just been started."""
    fake, open_page = shown
    fake.reset()
    open_page.fresh()
    return fake, open_page


# Text that lies on other text, and text that is cut off by its own box: nothing of either may be on the page.
COLLISIONS = """() => {
  const boxes = [], cut = [];
  for (const node of document.querySelectorAll("main *, header *")) {
    const own = [...node.childNodes].filter(child => child.nodeType === 3 && child.textContent.trim());
    if (!own.length || !node.offsetParent || node.tagName === "OPTION" || node.tagName === "SELECT") continue;
    if (node.id === "rig") continue;  // on a phone it ends with an ellipsis
    if (node.scrollWidth > node.clientWidth + 1 && getComputedStyle(node).overflow === "hidden")
      cut.push(node.textContent.trim());
    const fixed = Boolean(node.closest("#controls, #player"));
    for (const child of own) {
      const range = document.createRange();
      range.selectNodeContents(child);
      for (const box of range.getClientRects()) if (box.width > 1) boxes.push([node, box, child.textContent.trim(), fixed]);
    }
  }
  const over = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 2
    && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3;
  const found = [];
  boxes.forEach(([node, box, text, fixed], i) => boxes.slice(i + 1).forEach(([other, around, words, sticks]) => {
    // On a phone the commands stay in front of what scrolls below them.
    if (node !== other && fixed === sticks && over(box, around)) found.push(`${text} | ${words}`);
  }));
  return [...new Set(found.concat(cut))];
}"""


@pytest.mark.parametrize("name", STATES)
def test_each_state_is_named_readable_and_fits_the_screen(shown: tuple[Fake, OpenPage], name: str) -> None:
    fake, open_page = shown
    fake.state, page = STATES[name], open_page.page
    safety, phase, cause = fake.state.says
    open_page.wait(lambda: (open_page.text("#action"), open_page.text("#mode")) == (safety, phase))
    for width, scheme in ((1280, "light"), (1280, "dark"), (360, "light"), (360, "dark")):
        open_page.look_as(width, scheme)
        assert cause in open_page.text("#cause")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(COLLISIONS) == []
        assert contrast(page) >= 4.5, (width, scheme)
    model = open_page.page.text_content("#model") or ""
    assert ("31 ± 4 mm behind the tip" in model) == (name == "body contact")
    assert "(3 sensors)" in model
    disabled = page.locator('[data-home="insertion"]').is_disabled()
    assert disabled == (name != "disarmed"), "an axis is homed while the rig is disarmed"
    assert open_page.complaints == []


def planned(step: int) -> dict[str, Any]:
    """A plan of eight steps from right to left; the hole of the puncture bends the last three."""
    shapes = []
    for number in range(8):
        bend_m = 0.014 - 0.004 * number
        shapes.append([[0.0, bend_m * (i / 11) ** 2, (0.021 + 0.0008 * number) * i / 11] for i in range(12)])
    # The tip stays, the shaft gives way to the tissue.
    bulged = [[x, y + 0.0025 * math.sin(math.pi * i / 11), z] for i, (x, y, z) in enumerate(shapes[-1])]
    pressed = {"shape": bulged, "force": [0.0, 0.0, 0.2]}
    return {"id": "2", "step": step, "shapes": shapes, "loads": [0.0] * 5 + [0.02, 0.05, 0.08], "pressed": pressed}


def test_a_plan_is_drawn_step_by_step_and_the_step_now_is_marked(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    fake.state = replace(STATES["hold"], mode="position", says=("No fault", "Moving", ""))
    open_page.look_as(1280, "light")
    open_page.wait(lambda: open_page.text("#mode") == "Moving")
    assert page.locator("#legend-plan").is_hidden() and "Plan" not in open_page.text("#scene-note")
    free = near(open_page.picture_of("#scene-card"), "#0b7285")
    pictures = []
    for step in (2, 6):
        fake.state = replace(fake.state, plan=planned(step))
        open_page.wait(lambda step=step: open_page.text("#scene-note").startswith(f"Plan, step {step + 1} of 8."))
        open_page.wait(lambda: page.evaluate("seldinger.scene.plan.children.length") == 16)
        page.wait_for_timeout(100)
        pictures.append(open_page.picture_of("#scene-card"))
    assert page.locator("#legend-plan").is_visible()
    assert near(pictures[0], "#0b7285") > free + 300, "the plan's steps"
    assert int((abs(pictures[1] - pictures[0]).max(axis=-1) > 20).sum()) > 300, "another step is marked"
    thickness = page.evaluate(
        "seldinger.scene.plan.children.filter((m, i) => i % 2 === 0).map(m => m.geometry.parameters.radius)"
    )
    assert [number for number, radius in enumerate(thickness) if radius == max(thickness)] == [6]
    # The loaded goal: another colour, with the force and its value.
    assert page.locator("#legend-loaded").is_visible()
    assert "Planned force at the goal 0.20 N." in open_page.text("#scene-note")
    assert near(pictures[1], "#a3127f") > 150
    fake.state = replace(fake.state, plan={**planned(6), "pressed": None})
    open_page.wait(lambda: page.evaluate("seldinger.scene.pressed.children.length") == 0)
    page.wait_for_timeout(100)
    assert near(open_page.picture_of("#scene-card"), "#a3127f") < 20 and page.locator("#legend-loaded").is_hidden()
    fake.state = replace(fake.state, plan=None)
    open_page.wait(lambda: page.evaluate("seldinger.scene.plan.children.length") == 0)
    assert open_page.complaints == []


def test_stop_acts_at_once_the_others_ask_and_the_answer_is_shown(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    for size in WIDTHS:
        open_page.look_as(size[0], "dark")
        page.evaluate("scrollTo(0, 0)")
        box = page.locator('[data-button="stop"]').bounding_box()
        assert box["y"] >= 0 and box["y"] + box["height"] <= size[1], "Stop is on the screen without scrolling"
    page.click('[data-button="arm"]')
    assert fake.asked == [] and "press again" in open_page.text("#answer")
    open_page.confirm("arm")
    open_page.wait(lambda: open_page.text("#answer") == "Arm: refused. no board")
    page.click('[data-button="stop"]')
    open_page.wait(lambda: len(fake.asked) == 2)
    assert fake.asked == [{"button": "arm", "confirmed": True}, {"button": "stop", "confirmed": True}]
    fake.state = replace(fake.state, silent_s=3.0)
    open_page.wait(lambda: open_page.text("#action") == "No data")
    assert "old" in open_page.text("#cause") and open_page.complaints == []


def test_an_axis_is_homed_after_a_second_press_and_only_where_it_has_a_switch(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    fake.state, fake.result = STATES["disarmed"], "accepted"
    button = page.locator('[data-home="insertion"]')
    open_page.wait(lambda: bool(button.is_enabled()))
    assert page.locator('[data-home="roll"]').is_hidden() and page.locator('[data-home="knob"]').is_hidden()
    button.click()
    assert fake.asked == [] and open_page.text("#answer") == "Home insertion: press again to confirm."
    button.evaluate("b => { if (!b.classList.contains('asks')) b.click(); b.click(); }")
    open_page.wait(lambda: open_page.text("#answer").startswith("Home: accepted."))
    assert fake.asked == [{"button": "home", "confirmed": True, "axis": "insertion"}]
    assert button.inner_text() == "Home insertion"


def test_a_command_whose_answer_is_lost_is_not_left_waiting(rig: tuple[Fake, OpenPage]) -> None:
    """The page loses its server between a command and its answer: it says so, and connects again."""
    fake, open_page = rig
    answered = threading.Event()
    fake.waits_for = answered
    try:
        open_page.confirm("arm")
        open_page.wait(lambda: len(fake.asked) == 1)
        open_page.page.evaluate("seldinger.socket.close()")
        open_page.wait(lambda: "may or may not have been carried out" in open_page.text("#answer"))
    finally:
        answered.set()
    open_page.wait(lambda: open_page.text("#link") == "live")


def test_a_jog_lasts_as_long_as_its_button_is_held(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    fake.state, fake.result = STATES["hold"], "accepted"
    for width, _ in WIDTHS:
        open_page.look_as(width, "light")
        fake.asked.clear()
        button = page.locator('[data-jog="-e2"]')
        button.scroll_into_view_if_needed()
        button.dispatch_event("pointerdown", {"button": 0, "pointerId": 1, "isPrimary": True})
        open_page.wait(lambda: len(fake.asked) >= 3)
        wanted = {"button": "jog", "axis": "tip", "forwards": False, "share": 0.5, "direction": [0, 1, 0]}
        assert fake.asked[0] == wanted
        assert contrast(page) >= 4.5
        button.dispatch_event("pointerup", {"button": 0, "pointerId": 1})
        open_page.wait(lambda: fake.asked[-1]["button"] == "hold")
        count = len(fake.asked)
        page.wait_for_timeout(400)
        assert len(fake.asked) == count, "nothing is repeated after the button was let go"


def test_a_refused_jog_is_not_repeated_and_keys_jog_only_when_asked(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    page.keyboard.press("ArrowUp")
    page.check("#keys")
    assert fake.asked == []
    page.keyboard.down("ArrowUp")
    open_page.wait(lambda: open_page.text("#answer") == "Jog: refused. no board")
    count = len(fake.asked)
    page.wait_for_timeout(400)
    page.keyboard.up("ArrowUp")
    assert len(fake.asked) <= count + 1 and all(item["button"] == "jog" for item in fake.asked)
    page.keyboard.press("Escape")
    open_page.wait(lambda: fake.asked[-1]["button"] == "stop")
    assert open_page.complaints == []


def test_a_typed_point_is_confirmed_and_sent_in_metres(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    page.click('[data-do="goto"]')
    assert fake.asked == [] and "number is missing" in open_page.text("#answer")
    for name, value in (("x-mm", "0"), ("y-mm", "-10.7"), ("z-mm", "21")):
        page.fill(f"#{name}", value)
    page.evaluate("() => { const b = document.querySelector('[data-do=\"goto\"]'); b.click(); b.click(); }")
    open_page.wait(lambda: len(fake.asked) == 1)
    assert fake.asked[0]["button"] == "goto" and fake.asked[0]["point_m"] == pytest.approx([0, -0.0107, 0.021])
    page.fill("#note", "sheath moved")
    page.click("#mark button")
    open_page.wait(lambda: len(fake.asked) == 2)
    assert fake.asked[1] == {"button": "mark", "note": "sheath moved"}


def test_a_point_is_picked_on_the_tissue_and_moves_nothing_by_itself(rig: tuple[Fake, OpenPage]) -> None:
    fake, open_page = rig
    page = open_page.page
    open_page.wait(lambda: open_page.text("#action") == "Retracting")
    open_page.wait(lambda: page.evaluate("window.seldinger.scene.newest !== undefined"))
    across, down = page.evaluate(
        "() => { const s = window.seldinger.scene, v = s.target.position.clone().project(s.camera);"
        " const b = s.renderer.domElement.getBoundingClientRect();"
        " return [b.left + (v.x + 1) / 2 * b.width, b.top + (1 - v.y) / 2 * b.height]; }"
    )
    picked = []
    for aside in (-12, 12):
        page.mouse.dblclick(across + aside, down)
        open_page.wait(lambda: open_page.text("#answer").startswith("Picked"))
        picked.append([float(page.input_value(f"#{name}")) for name in ("x-mm", "y-mm", "z-mm")])
    # The tissue of this rig is the plane through its target, z = 25 mm: picks differ along it and stay on it.
    assert [point[2] for point in picked] == [25.0, 25.0] and math.dist(*picked) > 1.0
    assert fake.asked == []
    page.evaluate("() => { const b = document.querySelector('[data-do=\"goto\"]'); b.click(); b.click(); }")
    open_page.wait(lambda: len(fake.asked) == 1)
    assert fake.asked[0]["point_m"] == pytest.approx([mm / 1000 for mm in picked[1]])
    # At the upper edge of the scene the ray meets the plane of the tissue far away or never.
    page.mouse.dblclick(across, page.locator("#scene").bounding_box()["y"] + 12)
    open_page.wait(lambda: "tissue is not known" in open_page.text("#answer"))
    assert open_page.complaints == []


def contrast(page: Any) -> float:
    """The least contrast (WCAG) of visible text against the card or page behind it."""
    return float(
        page.evaluate(
            """() => {
        const channel = c => { c /= 255; return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; };
        const parse = text => text.match(/[\\d.]+/g).map(Number);
        const light = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
        const behind = node => {
          for (; node; node = node.parentElement) {
            const color = parse(getComputedStyle(node).backgroundColor);
            if (color.length < 4 || color[3] === 1) return color;
          }
          return [255, 255, 255];
        };
        let least = 21;
        for (const node of document.querySelectorAll("main *, header *")) {
          const own = [...node.childNodes].some(child => child.nodeType === 3 && child.textContent.trim());
          if (!own || !node.offsetParent || node.closest("#scene-card")) continue;
          const front = light(parse(getComputedStyle(node).color)), back = light(behind(node));
          least = Math.min(least, (Math.max(front, back) + 0.05) / (Math.min(front, back) + 0.05));
        }
        return least;
      }"""
        )
    )


def asked(open_page: OpenPage, button: str, name: str) -> str:
    """The rig's answer to a button that asks, in the page's words; or that the page has lost its server."""
    open_page.confirm(button)
    open_page.wait(
        lambda: open_page.text("#answer").startswith(f"{name}: ") and "sent, waiting" not in open_page.text("#answer")
    )
    return open_page.text("#answer")


@pytest.mark.slow
def test_a_running_rig_is_homed_armed_held_and_stopped_from_the_page(browser: Any, tmp_path: Path) -> None:
    """The rig runs in virtual time, so that a stall of this machine stops neither it nor its lease."""
    rig = rig_with_a_switch(tmp_path)
    there, here = loopback(rig)
    with (
        there,
        here,
        VirtualRig(rig, there) as virtual,
        closing(LiveRig(rig, here)) as live,
        Commander(here, "view", clock_ns=lambda: virtual.now_ns) as commander,
        running(ViewServer(live, port := free_port())),
        # A software renderer leaves the rig too little beside a larger page.
        OpenPage(browser, port, WIDTHS[1]) as open_page,
    ):
        live._commander, page = commander, open_page.page

        def accepted(button: str, name: str) -> Callable[[], bool]:
            """Whether the rig accepts the command; a late or lost answer of a busy machine is asked for again."""

            def tried() -> bool:
                answer = asked(open_page, button, name)
                assert ": refused" not in answer, answer
                return answer.startswith(f"{name}: accepted")

            return tried

        home = page.locator('[data-home="insertion"]')
        open_page.wait(lambda: open_page.text("#mode") == "Disarmed" and bool(home.is_enabled()))

        def homing() -> bool:
            """Whether the page shows the homing or, if that was over before the page was drawn again, its result."""
            return open_page.text("#mode") == "Homing" or "insertion: switch found" in open_page.text("#log")

        def homes() -> bool:
            if homing():
                return True
            home.evaluate("b => { if (!b.classList.contains('asks')) b.click(); b.click(); }")
            open_page.wait(lambda: re.match("Home: (?!sent)", open_page.text("#answer")) is not None)
            return until(homing, patience_s=5.0)

        until(homes, "the axis to be homed")
        open_page.wait(lambda: "insertion: switch found" in open_page.text("#log"))
        open_page.wait(lambda: open_page.text("#mode") == "Disarmed")
        until(accepted("arm", "Arm"), "the rig to be armed")
        open_page.wait(lambda: open_page.text("#mode") == "Holding")
        until(accepted("hold", "Hold"), "the rig to hold")
        page.click('[data-button="stop"]')
        open_page.wait(lambda: re.match("Stop: (?!sent)", open_page.text("#answer")) is not None)
        open_page.wait(lambda: open_page.text("#mode") == "Stopped")
        answer = open_page.text("#answer")
        # A stall of this machine may keep the rig's state from showing the stop within 100 ms; then the page says so.
        assert answer.startswith(("Stop: accepted. confirmed by ", "Stop: not confirmed. ")), answer
        assert open_page.text("#action") == "Stopped" and open_page.complaints == []
