"""The page of `tlq.play`: a robot on its terrain in the browser, by viser, which `pip install 'tlq[play]'` brings.

One thread runs the simulation and draws. What visitors press is put into a queue, and done by that thread between two
control steps; clips are rendered by threads of their own, so that the robot walks on. The page is served to this
machine alone: whoever opens it can read policy files and write clips.
"""

import errno
import math
import os
import queue
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

import terrains
from tlq.cli import one_line
from tlq.senses import KINDS, MOST, PerceptionConfig
from tlq.session import FASTEST_PUSH, Clip, Session, clip_path
from tlq.stage import MARKS, Stage

HOST = "127.0.0.1"
FRAMES, READINGS, LOOKS = 1 / 25, 1 / 4, 1.0
"""Seconds between pictures, between figures, as of the elevation map, and between looks at the policy's file."""
HISTORY = 10.0
"""Seconds that the plots show."""
ARROWS = (
    {"↖": 45.0, "↑": 0.0, "↗": -45.0},
    {"←": 90.0, "stand": None, "→": -90.0},
    {"↙": 135.0, "↓": 180.0, "↘": -135.0},
)
"""Directions in degrees as the robot faces at the start, left positive."""
ERRORS = {
    "drift": "m per metre walked",
    "latency": "s",
    "missing": "share of the returns",
    "range_noise": "multiple of the sensor's own",
}
"""What the numbers are that make range sensors worse."""
PUSHES = {"←": 90.0, "↑": 0.0, "↓": 180.0, "→": -90.0}


def load_viser() -> Any:
    """The library; raises ValueError where it isn't installed."""
    try:
        import viser
    except ImportError:
        raise ValueError(
            "viewer=browser needs viser: pip install 'tlq[play]'; or choose viewer=native"
        ) from None
    return viser


def check_port(port: int) -> None:
    """Raises ValueError if no page can be served there."""
    if not 1 <= port <= 65535:
        raise ValueError(f"port={port} must be in [1, 65535]")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        if os.name == "posix":  # as servers do: connections that have just been closed don't count
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            why = "is in use" if error.errno == errno.EADDRINUSE else f"can't be used ({error.strerror})"
            raise ValueError(f"port={port} {why}; choose another one") from None


def serve(session: Session, port: int) -> None:
    """Serves the page until it is interrupted."""
    check_port(port)
    server = load_viser().ViserServer(host=HOST, port=port, label="tlq", verbose=False)
    try:
        if server.get_port() != port:  # viser goes on to the next free one
            raise ValueError(f"port={port} is in use; choose another one")
        page = Page(server, session)
        print(f"open http://localhost:{port} (Ctrl-C ends it)", flush=True)
        page.run()
    finally:
        server.stop()


class Page:
    """Controls, figures and scene of one session on one server."""

    def __init__(self, server: Any, session: Session):
        self.session, self.gui, self._server = session, server.gui, server
        self._orders: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._ended = threading.Event()
        self._history: deque[tuple[float, ...]] = deque()
        self._clock = 0.0
        self.stage = Stage(server)
        self._drawn: Any = None
        self.gui.configure_theme(show_logo=False, show_share_button=False)
        self.gui.set_panel_label("tlq")
        self._news = self.gui.add_markdown("")
        parts = (
            self._walking,
            self._time,
            self._push,
            self._terrain,
            self._sensing,
            self._policy,
            self._clip,
        )
        for part in parts:
            part()
        self._marks()
        self._figures()

    # -- the thread of the simulation

    def run(self) -> None:
        """Simulates and draws until `end` is called."""
        last = time.monotonic()
        due = dict.fromkeys((self._draw, self._draw_map, self._read, self._look), last)
        periods = dict(zip(due, (FRAMES, READINGS, READINGS, LOOKS), strict=True))
        while not self._ended.is_set():
            now = time.monotonic()
            self._obey()
            self._clock += self.session.sim.controller.control_dt * self.session.advance(now - last)
            last = now
            for work, when in due.items():
                if now >= when:
                    work()
                    due[work] = time.monotonic() + periods[work]
            time.sleep(0.002)

    def end(self) -> None:
        """Makes `run` return; from any thread."""
        self._ended.set()

    def order(self, what: Callable[[], object]) -> None:
        """Has the simulation's thread do something; from any thread."""
        self._orders.put(what)

    def _obey(self) -> None:
        while not self._orders.empty():
            self._try(self._orders.get())

    def _try(self, what: Callable[[], object]) -> None:
        """Errors of the visitor's are news, and all goes on."""
        try:
            what()
        except (ValueError, OSError) as error:
            self.session.news = f"error: {one_line(error)}"

    def _draw(self) -> None:
        sim = self.session.sim
        with self._server.atomic():
            if self._drawn is not sim:
                self.stage.build(sim)
                self._drawn = sim
            self.stage.draw(sim, self.session.direction)
        self._remember()

    def _draw_map(self) -> None:
        if self._drawn is self.session.sim:
            self.stage.draw_map(self.session.sim)

    def _look(self) -> None:
        self._try(self.session.refresh)
        if str(self.session.path) != self._loaded.content:
            self._loaded.content = str(self.session.path)

    # -- controls

    def _walking(self) -> None:
        with self.gui.add_folder("Direction"):
            for row in ARROWS:
                group = self.gui.add_button_group("", tuple(row))
                group.on_click(lambda event, row=row: self._arrow(row[event.target.value]))
            self._angle = self.gui.add_slider("degrees", -180, 180, 1, 0, hint="0 is ahead, left is positive")
            self._angle.on_update(lambda _: self._towards(self._angle.value))

    def _arrow(self, degrees: float | None) -> None:
        if degrees is None:
            self.order(self.session.stand)
            return
        self._angle.value = round(degrees)
        self._towards(degrees)

    def _towards(self, degrees: float) -> None:
        self.order(lambda: self.session.walk(math.radians(degrees)))

    def _time(self) -> None:
        with self.gui.add_folder("Time"):
            pause = self.gui.add_checkbox("pause", False)
            step = self.gui.add_button("single step")
            speed = self.gui.add_slider("speed", 0.05, 1.0, 0.05, 1.0, hint="1 is real time")
            restart = self.gui.add_button("start anew")
        pause.on_update(lambda _: self.order(lambda: setattr(self.session, "paused", pause.value)))
        speed.on_update(lambda _: self.order(lambda: setattr(self.session, "speed", speed.value)))
        restart.on_click(lambda _: self.order(self.session.restart))

        def one() -> None:
            self.session.paused = True
            self.session.step()
            self._clock += self.session.sim.controller.control_dt

        @step.on_click
        def _(_: Any) -> None:
            pause.value = True
            self.order(one)

    def _push(self) -> None:
        with self.gui.add_folder("Push"):
            speed = self.gui.add_slider("m/s", 0.1, FASTEST_PUSH, 0.1, 0.6)
            group = self.gui.add_button_group("", tuple(PUSHES))

        @group.on_click
        def _(event: Any) -> None:
            angle = math.radians(PUSHES[event.target.value])
            self.order(lambda: self.session.push(angle, speed.value))

    def _terrain(self) -> None:
        now = self.session.sim.terrain
        with self.gui.add_folder("Terrain"):
            kind = self.gui.add_dropdown("kind", terrains.kinds(), initial_value=self.session.kind)
            level = self.gui.add_slider(
                "difficulty", 0.0, 1.0, 0.05, now.difficulty, hint=f"the paper's is {terrains.PAPER}"
            )
            seed = self.gui.add_number("seed", self.session.seed, min=0, step=1)
            build = self.gui.add_button("build")
        build.on_click(
            lambda _: self.order(lambda: self.session.build(kind.value, level.value, int(seed.value)))
        )

    def _sensing(self) -> None:
        now = self.session.perception or PerceptionConfig()
        kind = "map" if self.session.perception is None else now.kind
        with self.gui.add_folder("Heights from"):
            self._sensor = self.gui.add_dropdown(
                "sensor", KINDS, initial_value=kind, hint="map: true heights"
            )
            errors = {
                name: self.gui.add_slider(name, 0.0, most, 0.01, getattr(now, name), hint=ERRORS[name])
                for name, most in MOST.items()
            }
            use = self.gui.add_button("use")

        @use.on_click
        def _(_: Any) -> None:
            chosen = {name: slider.value for name, slider in errors.items()}
            kind = self._sensor.value
            sensing = None if kind == "map" else PerceptionConfig(kind=kind, **chosen)
            self.order(lambda: self.session.sense(sensing))

    def _policy(self) -> None:
        with self.gui.add_folder("Policy"):
            self._loaded = self.gui.add_markdown("")
            other = self.gui.add_text("another", "", hint="a file, a run's folder, or the name of a policy")
            load = self.gui.add_button("load")
        load.on_click(lambda _: self.order(lambda: self.session.load(other.value)))

    def _clip(self) -> None:
        with self.gui.add_folder("Clip"):
            name = self.gui.add_text("file", "clip.mp4")
            record, save = self.gui.add_button("record"), self.gui.add_button("save")
        record.on_click(lambda _: self.order(self.session.record))
        save.on_click(lambda _: self.order(lambda: self._save(name.value)))

    def _save(self, name: str) -> None:
        path = clip_path(name)  # before the clip ends: after a wrong name it can still be saved
        clip = self.session.take_clip()
        self.session.news = f"writing {path}"
        threading.Thread(target=self._write, args=(clip, str(path)), daemon=True).start()

    def _write(self, clip: Clip, name: str) -> None:
        try:
            news = f"wrote {clip.write(name)}"
        except (ValueError, OSError) as error:
            news = f"error: {one_line(error)}"
        self.order(lambda: setattr(self.session, "news", news))

    def _marks(self) -> None:
        with self.gui.add_folder("Show"):
            for mark in MARKS:
                box = self.gui.add_checkbox(mark, True)
                box.on_update(lambda event, mark=mark: self.stage.show(mark, event.target.value))
            follow = self.gui.add_checkbox("follow the robot", True)
        follow.on_update(lambda _: setattr(self.stage, "follow", follow.value))

    # -- figures

    def _plot(self, title: str, curves: dict[str, str]) -> Any:
        """A plot over seconds of curves with these names and colours."""
        uplot = load_viser().uplot
        series = [uplot.Series(label=name, stroke=colour, width=1.5) for name, colour in curves.items()]
        return self.gui.add_uplot(
            (np.zeros(1),) * (1 + len(curves)),
            (uplot.Series(label="s"), *series),
            title=title,
            scales={"x": uplot.Scale(time=False)},
            aspect=1.7,
        )

    def _figures(self) -> None:
        panel = self.gui.add_panel()
        with panel.add_tab("Figures"):
            self._table = self.gui.add_markdown("")
            self._tg_plot = self._plot(
                "trajectory generator", {"δf, Hz": "#2980e6", "mean δh, cm": "#f27d1a"}
            )
            self._reward_plot = self._plot(
                "along the command", {"speed, m/s": "#33a65a", "reward": "#a64ac9"}
            )
        panel.dock_left()
        panel.set_width(320)

    def _read(self) -> None:
        session = self.session
        news = session.news.replace("`", "'")
        self._news.content = f"`{news}`" if news else ""
        self._table.content = readings(session)
        clock, frequency, lift, speed, reward = np.array(self._history).T
        self._tg_plot.data = (clock, frequency, lift)
        self._reward_plot.data = (clock, speed, reward)

    def _remember(self) -> None:
        session = self.session
        if self._history and self._history[-1][0] == self._clock:
            return  # paused
        lift = 100.0 * float(session.lift_change.mean())
        speed = float(session.sim.data.qvel[:2] @ session.direction)
        self._history.append(
            (self._clock, session.frequency_change, lift, speed, session.terms.get("total", 0.0))
        )
        while self._history[0][0] < self._clock - HISTORY:
            self._history.popleft()


def readings(session: Session) -> str:
    """Figures of the present moment, as a table in Markdown."""
    lifts = " ".join(f"{100 * lift:+.1f}" for lift in session.lift_change)
    energy = session.energy_per_metre
    rows = {
        "δf": f"{session.frequency_change:+.2f} Hz",
        "δh (LF RF LR RR)": f"{lifts} cm",
        "energy": "" if math.isnan(energy) else f"{energy:.0f} J/m",
        "distance": f"{session.distance:.2f} m in {session.time:.1f} s",
        "falls": str(session.falls),
    }
    if session.recorded is not None:
        rows["clip"] = f"{session.recorded:.1f} s"
    rows |= {f"reward: {name}": f"{value:+.3f}" for name, value in session.terms.items()}
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])
