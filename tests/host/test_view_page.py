"""The page in a real browser, 1280 and 360 pixels wide: all drawn, nothing wider than the screen, buttons that ask."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from host.recordings.recording import RecordingFile
from host.run.demo import DemoSettings
from host.run.wall_clock import Fleet
from host.view.live import LiveRig
from host.view.replay import Findings, Replay, Window
from host.view.server import ADDRESS, ViewServer
from protocol.rig_file import load_rig
from protocol.zenoh_session import Session
from tests.host.test_foxglove import recording  # noqa: F401 - a fixture
from tests.host.test_view import free_port, running
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
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.set_default_timeout(1e3 * PATIENCE_S)
        self.page.goto(f"http://{ADDRESS}:{port}/")
        self.wait(lambda: self.page.evaluate("window.seldinger.frames > 10 && Boolean(window.seldinger.scene)"))

    def _hear(self, kind: str, text: str) -> None:
        # The software renderer complains of itself: reading pixels back is slow.
        if kind in ("error", "warning") and "GPU stall" not in text:
            self.complaints.append(text)

    @staticmethod
    def wait(happened: Callable[[], bool]) -> None:
        until(happened, "the page")

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


@pytest.mark.parametrize("size", WIDTHS, ids=lambda size: f"{size[0]}px")
def test_a_recording_is_drawn_and_can_be_moved_about_in(browser: Any, size: tuple[int, int], recording: Path) -> None:  # noqa: F811
    findings = Findings(
        verdict="missing_physics",
        says=["Play of 3.1 mm in insertion."],
        windows=[Window(subsystem="insertion", condition="after reversals", span_s=(0.2, 0.4))],
    )
    with (
        running(ViewServer(Replay(RecordingFile(recording), findings=findings), port := free_port())),
        OpenPage(browser, port, size) as open_page,
    ):
        page = open_page.page
        open_page.wait(lambda: open_page.text("#play") == "Again")
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        assert open_page.text("#mode") == "Contact" and open_page.text("#action") == "No fault"
        assert open_page.text("#force") == "0.200 N" and "Play of 3.1 mm" in page.text_content("#findings")
        mark = page.evaluate("[...document.querySelectorAll('#windows i')].map(i => [i.style.left, i.style.width])")
        assert [[round(float(part.rstrip("%"))) for part in one] for one in mark] == [[20, 20]]
        page.evaluate("seek.value = 0.5; seek.dispatchEvent(new Event('input'))")
        open_page.wait(lambda: open_page.text("#clock").startswith("0.5 of"))
        scene = open_page.picture_of("#scene-card")
        assert near(scene, "#2563c9") > 300, "the catheter"
        page.evaluate("() => { seldinger.scene.wall.children[0].visible = false; seldinger.scene.render(); }")
        open_page.wait(lambda: bool((abs(open_page.picture_of("#scene-card") - scene).max(axis=-1) > 20).sum() > 1000))
        assert near(open_page.picture_of("#pose-card"), "#2563c9") > 30, "the trace of the tip"
        assert page.locator("#controls").is_hidden() and open_page.complaints == []


class Fake:
    """A live rig that stands still and notes what it is asked."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.silent_s: float | None = 0.01
        self.causes = ["contact force above the limit: retracting"]
        self.result = "refused"

    def hello(self) -> dict[str, Any]:
        return {
            "kind": "live",
            "rig": "simulated",
            "catheter": "blazer_prime_xp",
            "over_force_N": 0.5,
            "radius_m": 0.0012,
            "past": {"rows": [], "estimates": [], "log": []},
        }

    def frame(self) -> dict[str, Any]:
        now = time.monotonic()
        return {
            "t": now,
            "mode": "retract",
            "action": "retract",
            "causes": self.causes,
            "force_N": 0.51,
            "target_force_N": 0.2,
            "pose_age_ms": 20.0,
            "rejected": [0, 1],
            "rows": [[now, 0.51, 0.2, 0.0, -0.007, 0.028, 0.0, -0.01, 0.025]],
            "estimates": [[now, 0.5, 0.02]],
            "loop": None,
            "board": None,
            "silent_s": self.silent_s,
            "malformed": 0,
            "scene": {
                "shape": [[0, 0, 0.002 * i] for i in range(15)],
                "gap_m": 0.001,
                "tip": [0, 0, 0.028],
                "force": [0, 0, 0.5],
                "estimate": [],
                "target": [0, -0.01, 0.025],
                "into": [0, 0, 1],
                "poses": {},
            },
        }

    def act(self, text: str) -> dict[str, Any]:
        self.asked.append(json.loads(text))
        return {"action": self.asked[-1]["button"], "result": self.result, "text": "no board"}


@pytest.mark.parametrize("size", WIDTHS, ids=lambda size: f"{size[0]}px")
def test_stop_acts_at_once_the_others_ask_and_the_answer_is_shown(browser: Any, size: tuple[int, int]) -> None:
    fake = Fake()
    with running(ViewServer(fake, port := free_port())), OpenPage(browser, port, size) as open_page:
        page = open_page.page
        open_page.wait(lambda: open_page.text("#action") == "Retracting")
        assert open_page.text("#cause") == "Contact force above the limit: retracting."
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        box = page.locator('[data-button="stop"]').bounding_box()
        assert box["y"] >= 0 and box["y"] + box["height"] <= size[1], "Stop is on the screen without scrolling"
        page.click('[data-button="arm"]')
        assert fake.asked == [] and "press again" in open_page.text("#answer")
        open_page.confirm("arm")
        open_page.wait(lambda: open_page.text("#answer") == "Arm: refused. no board")
        page.click('[data-button="stop"]')
        open_page.wait(lambda: len(fake.asked) == 2)
        assert fake.asked == [{"button": "arm", "confirmed": True}, {"button": "stop", "confirmed": True}]
        fake.silent_s = 3.0
        open_page.wait(lambda: open_page.text("#action") == "No data")
        assert "old" in open_page.text("#cause") and open_page.complaints == []


@pytest.mark.parametrize("size", WIDTHS, ids=lambda size: f"{size[0]}px")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_jog_lasts_as_long_as_its_button_is_held(browser: Any, size: tuple[int, int], scheme: str, tmp_path: Path) -> None:
    fake = Fake()
    fake.causes = []
    fake.result = "accepted"
    with running(ViewServer(fake, port := free_port())), OpenPage(browser, port, size) as open_page:
        page = open_page.page
        page.emulate_media(color_scheme=scheme)
        button = page.locator('[data-jog="-e2"]')
        button.scroll_into_view_if_needed()
        button.dispatch_event("pointerdown", {"button": 0, "pointerId": 1, "isPrimary": True})
        open_page.wait(lambda: len(fake.asked) >= 3)
        assert fake.asked[0] == {"button": "jog", "axis": "tip", "forwards": False, "share": 0.5, "direction": [0, 1, 0]}
        page.screenshot(path=str(tmp_path / "jog.png"), full_page=True)
        button.dispatch_event("pointerup", {"button": 0, "pointerId": 1})
        open_page.wait(lambda: fake.asked[-1]["button"] == "hold")
        count = len(fake.asked)
        page.wait_for_timeout(400)
        assert len(fake.asked) == count, "nothing is repeated after the button was let go"
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        assert contrast(page) >= 4.5


def test_a_refused_jog_is_not_repeated_and_keys_jog_only_when_asked(browser: Any) -> None:
    fake = Fake()
    with running(ViewServer(fake, port := free_port())), OpenPage(browser, port, WIDTHS[0]) as open_page:
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


def test_a_typed_point_is_confirmed_and_sent_in_metres(browser: Any) -> None:
    fake = Fake()
    with running(ViewServer(fake, port := free_port())), OpenPage(browser, port, WIDTHS[0]) as open_page:
        page = open_page.page
        page.click('[data-do="goto"]')
        assert fake.asked == [] and "number is missing" in open_page.text("#answer")
        for field, value in (("x-mm", "0"), ("y-mm", "-10.7"), ("z-mm", "21")):
            page.fill(f"#{field}", value)
        page.evaluate("() => { const b = document.querySelector('[data-do=\"goto\"]'); b.click(); b.click(); }")
        open_page.wait(lambda: len(fake.asked) == 1)
        assert fake.asked[0]["button"] == "goto" and fake.asked[0]["point_m"] == pytest.approx([0, -0.0107, 0.021])
        page.fill("#note", "sheath moved")
        page.click("#mark button")
        open_page.wait(lambda: len(fake.asked) == 2)
        assert fake.asked[1] == {"button": "mark", "note": "sheath moved"}


def test_a_point_is_picked_on_the_tissue_and_moves_nothing_by_itself(browser: Any, tmp_path: Path) -> None:
    fake = Fake()
    with running(ViewServer(fake, port := free_port())), OpenPage(browser, port, WIDTHS[0]) as open_page:
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
            picked.append([float(page.input_value(f"#{field}")) for field in ("x-mm", "y-mm", "z-mm")])
        page.screenshot(path=str(tmp_path / "picked.png"))
        # The tissue of this rig is the plane through its target, z = 25 mm: picks differ along it and stay on it.
        assert [point[2] for point in picked] == [25.0, 25.0] and math.dist(*picked) > 1.0
        assert fake.asked == []
        page.evaluate("() => { const b = document.querySelector('[data-do=\"goto\"]'); b.click(); b.click(); }")
        open_page.wait(lambda: len(fake.asked) == 1)
        assert fake.asked[0]["point_m"] == pytest.approx([mm / 1000 for mm in picked[1]])
        page.mouse.dblclick(across, down - 90)  # above the tissue, where the ray meets its plane far away or never
        open_page.wait(lambda: "No tissue" in open_page.text("#answer"))
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
def test_a_running_rig_is_armed_held_and_stopped_from_the_page(browser: Any, tmp_path: Path) -> None:
    settings = DemoSettings(board="native", directory=tmp_path, estimator="tests.host.no_estimator:make")
    with Fleet(settings, tmp_path / "view.mcap") as fleet:
        fleet.wait_for_state()
        rig = load_rig(fleet.rig_file)
        with (
            Session.of_rig(rig) as session,
            closing(LiveRig(rig, session)) as live,
            running(ViewServer(live, port := free_port())),
            OpenPage(
                browser, port, WIDTHS[1]
            ) as open_page,  # a software renderer leaves the rig too little beside a larger one
        ):

            def held() -> bool:
                if open_page.text("#mode") == "Holding":
                    return asked(open_page, "hold", "Hold") == "Hold: accepted."
                asked(open_page, "clear", "Clear fault")  # of what a stall of this machine has stopped
                if asked(open_page, "arm", "Arm") == "Arm: accepted.":
                    until(lambda: open_page.text("#mode") == "Holding", patience_s=5.0)
                return False

            until(held, "the rig to be armed and to hold")

            def stopped() -> bool:
                open_page.page.click('[data-button="stop"]')
                open_page.wait(lambda: re.match("Stop: (?!sent)", open_page.text("#answer")) is not None)
                return until(lambda: open_page.text("#mode") == "Stopped", patience_s=5.0)

            until(stopped, "the rig to be stopped")
            answer = open_page.text("#answer")
            # A stall of this machine may keep the rig's state from showing the stop within 100 ms; then the page says so.
            assert answer.startswith(("Stop: accepted. confirmed by ", "Stop: not confirmed. ")), answer
            assert open_page.text("#action") == "Stopped" and open_page.complaints == []
