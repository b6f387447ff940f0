"""Showing a policy: pictures and videos of a walk, and answers to what can't be shown."""

import socket
import sys

import numpy as np
import pytest

from tests.tlq.policies import trained
from tlq import play
from tlq.render import RenderError


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that leaves walking to the trajectory generator."""
    small = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4}
    return trained(spread=0.0, **small).export(tmp_path_factory.mktemp("policy") / "policy.npz")


def arguments(file, **settings):
    given = {"policy": file, "terrain": "flat", "seconds": 0.3, **settings}
    return [f"{name}={value}" for name, value in given.items()]


def test_a_walk_is_recorded_step_by_step(file):
    options = play.Options(policy=str(file), terrain="flat", seconds=0.5)
    sim = play.simulation(options)
    start = sim.data.qpos.copy()
    record = play.walk(sim, np.pi / 2, options.seconds)
    assert record.qpos.shape == (26, 19) and not record.fell
    np.testing.assert_array_equal(record.qpos[0], start)
    np.testing.assert_array_equal(record.qpos[-1], sim.data.qpos)
    np.testing.assert_allclose(record.command, [0, 1], atol=1e-12)
    assert record.distance == pytest.approx((record.qpos[:, 1] - start[1]).max(), abs=0.02)


def test_a_walk_by_range_sensors(file):
    options = play.Options(policy=str(file), terrain="flat", perception="depth", drift=0.0, range_noise=2.0)
    sim = play.simulation(options)
    sensing = sim.perception.config
    assert (sensing.kind, sensing.drift, sensing.range_noise) == ("depth", 0.0, 2.0)
    assert not play.walk(sim, 0.0, 0.2).fell
    # Flat ground: 0 in the world, with the sensors' noise.
    assert 0 < np.abs(sim.heights + sim.data.qpos[2]).max() < 0.03


def test_a_blind_policy_needs_no_sensors(tmp_path):
    blind = trained("blind").export(tmp_path / "policy.npz")
    with pytest.raises(ValueError, match="perception=lidar is of no use to .* which is blind"):
        play.main([f"policy={blind}", "terrain=flat", "perception=lidar", "video=walk.mp4"])


def test_files_are_written(file, tmp_path, capsys):
    video, picture = tmp_path / "walk.mp4", tmp_path / "walk.png"
    try:
        play.main(arguments(file, video=video, picture=picture, moments=2))
    except RenderError as error:  # no OpenGL here
        pytest.skip(str(error))
    assert video.stat().st_size > 1000 and picture.stat().st_size > 1000
    assert "walked 0." in capsys.readouterr().out


def test_without_a_display_the_other_ways_are_named(file, monkeypatch):
    monkeypatch.setattr(play.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(
        ValueError, match=r"no display; write a file instead: video=FILE.mp4 or picture=FILE.png"
    ):
        play.main(arguments(file, viewer="native"))


def test_a_page_that_cannot_be_served_is_said_before_anything_takes_long(file, monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port={port} is in use; choose another one"):
            play.main(arguments(file, port=port))
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ValueError, match=r"needs viser: pip install 'tlq\[play\]'"):
        play.main(arguments(file))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"terrain": "pole"}, "unknown terrain 'pole'"),
        ({"difficulty": "hard"}, "unknown difficulty 'hard'"),
        ({"seed": -1}, "seed=-1 must be 0 or more"),
        ({"seconds": "nan"}, "seconds=nan must be in"),
        ({"moments": 0}, "moments=0 must be at least 1"),
        ({"video": "walk.avi"}, "video=walk.avi must end in .mp4"),
        ({"picture": "/no/where/a.png"}, "there is no folder /no/where"),
        ({"viewer": "window"}, "unknown viewer 'window'; choose one of browser, native"),
        ({"port": 0}, r"port=0 must be in \[1, 65535\]"),
        ({"port": 65536}, r"port=65536 must be in \[1, 65535\]"),
        ({"perception": "sonar"}, "unknown perception 'sonar'; choose one of map, lidar, depth"),
        ({"drift": 0.1}, "drift=0.1 needs perception=lidar or perception=depth"),
        ({"perception": "lidar", "missing": 2}, r"missing=2.0 must be in \[0, 1\]"),
        ({"policy": "nobody"}, "policy=nobody: no such policy"),
    ],
)
def test_wrong_settings_name_what_is_right(file, settings, message):
    with pytest.raises(ValueError, match=message):
        play.main(arguments(file, **settings))
