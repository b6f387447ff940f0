"""The benchmarks run, at sizes that say nothing of speed: what they measure is changed more often than they are run."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import terrains

ROOT = Path(__file__).parents[1]
SMALL = ["num_envs=16", "num_terrains=12", "rounds=1"]


def result(name, arguments, folder):
    """The JSON that a benchmark writes."""
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments, f"json={folder / 'result.json'}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "result.json").read_text())


@pytest.mark.parametrize("name", ["breakdown", "throughput"])
def test_no_rounds_are_refused_before_anything_is_built(name):
    command = [sys.executable, "-m", f"benchmarks.{name}", "rounds=0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "error: rounds=0 must be from 1 to 1000"


@pytest.mark.slow
def test_breakdown(tmp_path):
    shares = result("breakdown", [*SMALL, "unroll=2", "warm_up=1"], tmp_path)["share_of_iteration"]
    parts = {"physics", "contact look-ups", "height look-ups", "guide", "policy", "update"}
    assert shares["iteration"] == 1 and all(shares[part] > 0 for part in parts)


@pytest.mark.slow
def test_throughput(tmp_path):
    found = result("throughput", SMALL, tmp_path)
    assert found["env_vs_mujoco_c"] > 0 and found["training_vs_env"] > 0 and found["parameters"] > 100_000


@pytest.mark.slow
def test_footholds(tmp_path):
    """Long enough for feet to land beyond the start platform."""
    arguments = ["policy=flat", "difficulty=0.5", "robots=8", "seconds=2.5", "reflex=true"]
    found = result("footholds", arguments, tmp_path)
    assert 0.5 < found["distance_m"] <= 5 and 0 <= found["stance_over_gap"] <= 1
    assert 0 < found["moved_on_m"] < 0.1 and 0 < found["led_moves_m"] < 0.1
    assert 0 < found["landing_error_1_m"] < found["landing_error_8_m"] < 0.2


def test_monitor_compares_pair_by_pair():
    from benchmarks import monitor
    from tlq import judge
    from tlq.evaluate import Walk

    def walk(ended, progress, alarms=0):
        tally = judge.Tally(*[0.0] * len(judge.Tally._fields))._replace(ended=ended, progress=progress)
        return Walk(tally, alarms, None, 3.0 * alarms, 0.5)

    fell, stuck, reached = judge.FELL, judge.STUCK, judge.REACHED
    base = [walk(fell, 2.0), walk(fell, 1.0), walk(fell, 4.0), walk(reached, 5.02), walk(reached, 5.0)]
    watched = [walk(stuck, 1.5, 1), walk(fell, 0.9, 1), base[2], walk(fell, 2.6, 1), base[4]]
    found = monitor.compare(base, watched)
    assert (found["falls_without"], found["falls_with"]) == (3, 3)
    assert (found["prevented"], found["caused"], found["falls_without_alarm"]) == (1, 1, 1)
    # 2 + 1 + 4 + 5 + 5 = 17 m without, 1.5 + 0.9 + 4 + 2.6 + 5 = 14 m with.
    assert found["distance_lost"] == pytest.approx(3 / 17)
    assert found["falls_per_10_m_with"] == pytest.approx(30 / 14)
    assert (found["alarms"], found["stood_s"], found["reached_with"]) == (3, 9.0, 1)


def test_a_branched_simulation_goes_on_as_the_first_one(tmp_path):
    """Both from the same moment, with the same noise; and stepping one doesn't move the other."""
    from benchmarks import stopping
    from tlq import cli, evaluate
    from tlq.config import training_env
    from tlq.runtime import Controller
    from tlq.simulation import Simulation

    controller = Controller(cli.find_policy("flat"))
    config = training_env(controller.metadata)
    terrain = terrains.make_terrain("flat", 0.0, 9100)
    sim = Simulation(controller, terrain, config, noise=config.randomisation, seed=1)
    ahead = evaluate.direction(0)
    for _ in range(20):
        sim.step(ahead)
    before, other = sim.data.qpos.copy(), stopping.branch(sim)
    for _ in range(20):
        other.step(ahead)
    np.testing.assert_array_equal(sim.data.qpos, before)
    assert np.abs(other.data.qpos - before).max() > 0.05
    for _ in range(20):
        sim.step(ahead)
    np.testing.assert_array_equal(sim.data.qpos, other.data.qpos)


@pytest.mark.slow
def test_dynamics(tmp_path):
    found = result("dynamics", ["num_envs=8", "num_terrains=12", "steps=2", "rounds=1"], tmp_path)
    both = {f"{part}/{name}" for part in ("physics", "environment") for name in ("mjx", "tree")}
    assert found["steps_per_second"].keys() == found["compile_seconds"].keys() == both
    rates = found["steps_per_second"]
    for part, ratio in found["mjx_vs_tree"].items():
        assert ratio == pytest.approx(rates[f"{part}/tree"] / rates[f"{part}/mjx"])


@pytest.mark.slow
def test_perception(tmp_path):
    picture = tmp_path / "curves.png"
    arguments = [
        "policy=flat",
        "terrain=flat",
        "sweep=missing",
        "episodes=1",
        "walks=1",
        f"picture={picture}",
    ]
    found = result("perception", arguments, tmp_path)
    for kind in ("lidar", "depth"):
        assert [point["value"] for point in found["distance"]["missing"][kind]] == [0.05, 0.4, 0.8]
        assert 0 < found["distance"][kind]["mean_m"] <= 5
        assert abs(found[f"{kind}_errors"]["bias_m"]) < 0.02 and found[f"{kind}_sensing_ms"] > 0
    assert picture.stat().st_size > 5000
