"""Pictures: shapes, what is in them, files that read back, and an error that helps."""

import dataclasses

import av
import numpy as np
import pytest

import terrains
from envs.robot import RobotConfig, make_robot
from tlq import render as module
from tlq.render import render, strip, write_png, write_video

SIZE = (160, 96)


drawing = pytest.mark.usefixtures("gl")


@pytest.fixture
def gl():
    try:
        module.gl_context()
    except OSError as error:
        pytest.skip(str(error))


def walk(config=None, steps=11, speed=0.5):
    """A recording (T, 19) of a robot that glides along x."""
    robot = make_robot(config or RobotConfig())
    qpos = np.tile(robot.standing_qpos, (steps, 1))
    qpos[:, 0] += speed * 0.02 * np.arange(steps)
    return qpos


@drawing
@pytest.mark.parametrize("name", ["max", "go1_size"])
def test_frames_show_a_robot_under_a_sky(name):
    config = RobotConfig(name=name)
    frames = list(render(walk(config), robot=config, size=SIZE, fps=25))
    assert len(frames) == 6  # 0.2 s at 25 Hz, both ends
    assert all(frame.shape == (96, 160, 3) and frame.dtype == np.uint8 for frame in frames)
    top, middle = frames[0][:4].reshape(-1, 3), frames[0][30:66, 55:105].reshape(-1, 3)
    assert np.all(top[:, 2] > top[:, 0] + 15)
    orange = (middle[:, 0] > 1.8 * middle[:, 1].astype(int)) & (middle[:, 0] > 60)
    assert np.any(orange) and np.any(middle.max(axis=1) < 60) and np.any(middle.min(axis=1) > 180)


@drawing
def test_same_recording_gives_the_same_pictures():
    terrain = terrains.make_terrain("poles", "paper", seed=3)
    first, second = (list(render(walk(), terrain=terrain, size=SIZE, fps=10)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@drawing
def test_marks_are_drawn():
    qpos = walk(steps=1)
    feet = np.tile(np.array([0.2, -0.2, 0.1]), (1, 4, 1))
    (plain,) = render(qpos, size=SIZE)
    (marked,) = render(qpos, size=SIZE, command=np.array([1.0, 0.0]), feet=feet)
    (still,) = render(qpos, size=SIZE, command=np.zeros((1, 2)))
    green = (marked[..., 1] > marked[..., 0].astype(int) + 40) & (
        marked[..., 1] > marked[..., 2].astype(int) + 40
    )
    assert green.sum() > 10
    assert np.any(plain != marked)
    np.testing.assert_array_equal(plain, still)


@drawing
def test_hiding_what_is_out_of_sight_changes_no_pixel(monkeypatch):
    terrain = terrains.make_terrain("stepping_stones", "paper", seed=3)
    (hidden,) = render(walk(steps=1), terrain=terrain, size=SIZE)
    monkeypatch.setattr(module._Painter, "_hide_unseen", lambda *_: None)
    (whole,) = render(walk(steps=1), terrain=terrain, size=SIZE)
    assert np.mean(np.any(hidden != whole, axis=-1)) < 0.01


def test_camera_rises_over_what_is_in_the_way():
    # A wall 1 m high beside the path, between robot and a camera that looks along +y.
    wall = np.array([[0.0, -0.8, 2.0, 0.1, 0.0, 1.0]], np.float32)
    terrain = terrains.make_terrain("flat", 0.0, seed=0)
    terrain = dataclasses.replace(terrain, primitives=wall)
    focus = np.tile([0.0, 0.0, 0.3], (50, 1))
    tilt = module._elevations(focus, terrain, np.pi / 2, 0.3, 1.5, 10)
    # Over the wall's far edge, 0.9 m away, from 0.14 m: atan(0.86 / 0.9) = 0.76 rad.
    assert np.all(tilt > 0.7)
    assert np.all(module._elevations(focus, terrain, -np.pi / 2, 0.3, 1.5, 10) == pytest.approx(0.3))


def test_rows_follow_the_frame_rate():
    # 51 rows of 20 ms are 1 s: 26 pictures at 25 Hz, 11 at 10 Hz.
    np.testing.assert_array_equal(module._rows(51, 0.02, 25), np.arange(0, 51, 2))
    np.testing.assert_array_equal(module._rows(51, 0.02, 10), np.arange(0, 51, 5))


def test_video_reads_back(tmp_path):
    frames = [np.full((48, 64, 3), value, np.uint8) for value in (30, 120, 220)]
    path = write_video(tmp_path / "new" / "clip.mp4", iter(frames), fps=25)
    with av.open(str(path)) as container:
        read = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 25
    assert [round(frame.mean() / 10) for frame in read] == [3, 12, 22]


def test_png_reads_back(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (33, 47, 3), dtype=np.uint8)
    path = write_png(tmp_path / "new" / "picture.png", picture)
    with av.open(str(path)) as container:
        (frame,) = container.decode(video=0)
    np.testing.assert_array_equal(frame.to_ndarray(format="rgb24"), picture)


def test_strip_spaces_pictures_evenly():
    frames = [np.full((2, 3, 3), i, np.uint8) for i in range(9)]
    row = strip(frames, 3)
    assert row.shape == (2, 9, 3)
    np.testing.assert_array_equal(row[0, ::3, 0], [0, 4, 8])
    grid = strip(frames, 5, columns=3)
    assert grid.shape == (4, 9, 3)
    np.testing.assert_array_equal(grid[2, ::3, 0], [6, 8, 255])
    assert strip(frames[:2], 6).shape == (2, 6, 3)


@pytest.mark.parametrize("shape", [(19,), (0, 19), (5, 18)])
def test_wrong_recordings_are_refused(shape):
    with pytest.raises(ValueError, match=r"expected \(T, 19\)"):
        next(render(np.zeros(shape)))


def test_nothing_to_write_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="no frames"):
        write_video(tmp_path / "clip.mp4", [])
    with pytest.raises(ValueError, match="no frames"):
        strip([], 3)


def test_without_opengl_one_line_says_what_to_install(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(module.platform, "system", lambda: "Linux")
    monkeypatch.setattr(module, "_works", lambda backend: False)
    with pytest.raises(OSError, match="install EGL .*libegl1.*libosmesa6") as error:
        module.gl_context.__wrapped__()
    assert "\n" not in str(error.value)


def test_unknown_opengl_names_the_choices(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(ValueError, match="choose one of egl, osmesa, glfw"):
        module.gl_context.__wrapped__()
