"""The page in a real browser: headless Chromium presses what a visitor would."""

import base64
import contextlib
import io
import os
import shutil
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot as plt

from tests.tlq.policies import trained

pytest.importorskip("viser", reason="viser isn't installed: pip install 'tlq[play]'")

from tlq import insight, stage, viewer
from tlq.senses import PerceptionConfig
from tlq.session import Session

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
)
SMALL, WINDOW = (700, 340), (1200, 780)
"""Pixels: while the robot walks, which few of them are enough for, and of a picture."""
CAMERA, FOCUS = (0.92, -0.5, 0.64), (0.34, 0.26, 0.2)
"""Where the camera is and looks at (m): the robot, at (0, 0, 0.3), is seen between the panels."""
SELDOM = """
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = what => window.setTimeout(() => draw(what), 1000);
"""
"""A picture a second, instead of as many as can be drawn."""
PATIENCE = 300
"""Seconds for what takes one on a fast machine: WebGL is computed without a graphics card here."""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that leaves walking to the trajectory generator."""
    small = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4}
    return trained(spread=0.0, **small).export(tmp_path_factory.mktemp("policy") / "policy.npz")


@contextlib.contextmanager
def served(session):
    """A page, and its port."""
    viser = viewer.load_viser()
    with socket.socket() as probe:
        probe.bind((viewer.HOST, 0))
        port = probe.getsockname()[1]
    server = viser.ViserServer(host=viewer.HOST, port=port, verbose=False)
    page = viewer.Page(server, session)
    server.initial_camera.position, server.initial_camera.look_at = CAMERA, FOCUS
    thread = threading.Thread(target=page.run)
    thread.start()
    try:
        yield page, server.get_port()
    finally:
        page.end()
        thread.join(timeout=PATIENCE)
        server.stop()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium isn't installed")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("there is no chromium with its chromedriver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    options.page_load_strategy = "none"
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.command_executor.client_config.timeout = PATIENCE
    browser.set_page_load_timeout(PATIENCE)
    browser.set_script_timeout(PATIENCE)
    browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": SELDOM})
    yield browser
    browser.quit()


@pytest.fixture
def slowly(monkeypatch):
    """The browser draws without a graphics card: 25 pictures a second would leave no time for anything else."""
    monkeypatch.setattr(viewer, "FRAMES", 1.0)
    monkeypatch.setattr(stage, "FOLLOWING", 1.0)


def wait(condition, what):
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError(f"{what} within {PATIENCE} s")


def test_robot_and_elevation_map_are_drawn(file):
    """Without a browser: what the page is sent."""
    session = Session(file, "flat", perception=PerceptionConfig(kind="depth"))
    session.paused = True
    with served(session) as (page, _):
        wait(lambda: page.stage._bodies, "a robot")
        # Before its first step, too, it is drawn where it stands.
        trunk = page.stage._bodies[session.sim.model.body("trunk").id]
        wait(lambda: np.allclose(trunk.position, session.sim.data.qpos[:3]), "the robot in its place")
        (cloud,) = page.stage._marks["elevation map"]
        wait(lambda: len(cloud.points) > 100, "cells of the map")
        # Flat ground, a little above it, within reach of a robot in the middle.
        assert np.abs(cloud.points[:, 2]).max() < 0.05
        assert np.hypot(*cloud.points[:, :2].T).max() < stage.MAP_REACH + 0.1
        page.order(lambda: session.sense(None))
        wait(lambda: len(cloud.points) == 1, "no map any more")
        assert cloud.points[0, 2] < -10


def button(browser, label):
    """The button of this label, once it is there."""

    def find():
        found = browser.find_elements("xpath", f"//button[normalize-space(.)='{label}']")
        return found[0] if found else None

    return wait(find, f"a button '{label}'")


def press(browser, label):
    # Not by the pointer: that would need the button to be in view.
    browser.execute_script("arguments[0].click()", button(browser, label))


def picture(browser):
    """What the browser shows, as a PNG file's bytes; its own command for that gives up after ten seconds."""
    return base64.b64decode(browser.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})["data"])


def shows(browser, colour):
    """Whether a colour, 0 to 255, takes up some of the middle third, where no panel is."""
    found = plt.imread(io.BytesIO(picture(browser)))[..., :3]
    third = found.shape[1] // 3
    near = np.abs(255 * found[:, third : 2 * third] - colour).max(axis=-1) < 25
    return near.sum() > 100


def lead_onto_poles(browser, session):
    """Sends the robot ahead from the start by the page's buttons, until all its feet are off the platform."""
    session.stand()
    press(browser, "start anew")
    press(browser, "↑")
    wait(lambda: session.direction @ np.array([1.0, 0.0]) > 0.99, "a command ahead")
    session.paused = False
    wait(lambda: session.sim.data.qpos[0] > 1.0, "a walk ahead")
    session.paused = True
    time.sleep(0.1)
    assert insight.feet(session.sim)[:, 0].min() > session.sim.terrain.platform[0]
    # The page is up to date when its figures are: what was drawn before them was sent before them.
    wait(lambda: f"{session.distance:.2f} m in {session.time:.1f}" in browser.page_source, "the last figures")


def enlarge(browser):
    """A window for a picture, without the library's remark on slow graphics."""
    rule = "document.head.insertAdjacentHTML('beforeend', '<style>[class*=Notification] {display: none}</style>')"
    browser.execute_script(rule)
    browser.set_window_size(*WINDOW)


def save(browser, name, folder):
    """A picture of the page, where TLQ_PICTURES says or else in a folder."""
    path = Path(os.environ.get("TLQ_PICTURES", folder)) / f"{name}.png"
    path.write_bytes(picture(browser))


@pytest.mark.slow
def test_a_visitor_leads_the_robot_over_poles(slowly, browser, tmp_path):
    """The picture of README and docs/play.md."""
    session = Session("poles", "poles", 0.5)
    with served(session) as (_, port):
        browser.set_window_size(*SMALL)
        browser.get(f"http://localhost:{port}")
        lead_onto_poles(browser, session)
        assert session.falls == 0
        enlarge(browser)
        wait(lambda: shows(browser, stage.HIGH), "the sample points on poles")
        save(browser, "play", tmp_path)


@pytest.mark.slow
def test_buttons(slowly, browser, file):
    with served(Session(file, "flat")) as (page, port):
        session = page.session
        browser.set_window_size(*SMALL)
        browser.get(f"http://localhost:{port}")
        press(browser, "←")
        wait(lambda: session.direction @ np.array([0.0, 1.0]) > 0.99, "a command to the left")
        wait(lambda: session.sim.data.qpos[1] > 0.3, "a walk to the left")
        press(browser, "stand")
        wait(lambda: not session.direction.any(), "a command to stand")
        wait(lambda: "distance" in browser.page_source, "figures")
        press(browser, "single step")
        wait(lambda: session.paused, "a pause")
        press(browser, "load")
        wait(lambda: "no such policy" in browser.page_source, "the reason why no policy was loaded")
