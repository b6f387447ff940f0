"""The page in a real browser: headless Chromium presses what a visitor would."""

import shutil
import socket
import threading
import time

import numpy as np
import pytest

from tests.tlq.policies import trained

pytest.importorskip("viser", reason="viser isn't installed: pip install 'tlq[play]'")

from tlq import viewer
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
    "--window-size=900,600",
)
PATIENCE = 120
"""Seconds for what takes one on a fast machine: WebGL is computed without a graphics card here."""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that leaves walking to the trajectory generator."""
    small = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4}
    return trained(spread=0.0, **small).export(tmp_path_factory.mktemp("policy") / "policy.npz")


@pytest.fixture
def page(file, monkeypatch):
    """A page that is served, and its port."""
    # The browser draws without a graphics card: 25 pictures a second would leave no time for anything else.
    monkeypatch.setattr(viewer, "FRAMES", 1.0)
    viser = viewer.load_viser()
    with socket.socket() as probe:
        probe.bind((viewer.HOST, 0))
        port = probe.getsockname()[1]
    server = viser.ViserServer(host=viewer.HOST, port=port, verbose=False)
    page = viewer.Page(server, Session(file, "flat"))
    thread = threading.Thread(target=page.run)
    thread.start()
    yield page, server.get_port()
    page.end()
    thread.join(timeout=PATIENCE)
    server.stop()


@pytest.fixture
def browser(tmp_path):
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium isn't installed")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("there is no chromium with its chromedriver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    options.page_load_strategy = "none"
    for flag in (*FLAGS, f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(flag)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.set_page_load_timeout(PATIENCE)
    browser.set_script_timeout(PATIENCE)
    yield browser
    browser.quit()


def wait(condition, what):
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError(f"{what} within {PATIENCE} s")


def button(browser, label):
    """The button of this label, once it is there."""

    def find():
        found = browser.find_elements("xpath", f"//button[normalize-space(.)='{label}']")
        return found[0] if found else None

    return wait(find, f"a button '{label}'")


def press(browser, label):
    # Not by the pointer: that would need the button to be in view.
    browser.execute_script("arguments[0].click()", button(browser, label))


@pytest.mark.slow
def test_a_visitor_leads_the_robot(page, browser, tmp_path):
    page, port = page
    session = page.session
    browser.get(f"http://localhost:{port}")
    press(browser, "←")
    wait(lambda: session.direction @ np.array([0.0, 1.0]) > 0.99, "a command to the left")
    wait(lambda: session.sim.data.qpos[1] > 0.3, "a walk to the left")
    picture = tmp_path / "page.png"
    assert browser.save_screenshot(str(picture)) and picture.stat().st_size > 10_000
    press(browser, "stand")
    wait(lambda: not session.direction.any(), "a command to stand")
    wait(lambda: "distance" in browser.page_source, "figures")
    press(browser, "single step")
    wait(lambda: session.paused, "a pause")
    press(browser, "load")
    wait(lambda: "no such policy" in browser.page_source, "the reason why no policy was loaded")
