"""Evaluation: when episodes end and what they come to, figures, both engines, and answers to wrong command lines."""

import json
import math
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
import terrains
from tests.tlq.policies import trained
from tlq import cli, evaluate, judge
from tlq.cli import UsageError, parse
from tlq.config import training_env
from tlq.runtime import Controller
from tlq.simulation import Simulation, noisy

DT = 0.02
ORIGIN, EAST = np.zeros(2), np.array([1.0, 0.0])


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that leaves walking to the trajectory generator."""
    return trained(spread=0.0).export(tmp_path_factory.mktemp("evaluate") / "policy.npz")


# -- the judge -------------------------------------------------------------------------------------------------------


def moment(x=0.0, *, yaw=0.0, phases=-1.0, feet=0.025, low=0.0, work=0.0, fell=False):
    ground = np.zeros((4, 25))
    ground[:, :7] = low  # centre and 3 cm circle
    return judge.Moment(
        np.array([x, 0.3]),
        np.asarray(yaw),
        np.full(4, phases),
        np.full(4, feet),
        ground,
        np.asarray(work),
        np.asarray(fell),
    )


def judged(moments, direction=EAST):
    tally = judge.begin(moments[0])
    for m in moments[1:]:
        tally = judge.update(tally, m, ORIGIN, direction, DT)
    return tally


def test_goal_fall_and_patience_end_an_episode():
    assert judged([moment(), moment(4.99)]).ended == judge.RUNNING
    assert judged([moment(), moment(5.0)]).ended == judge.REACHED
    assert judged([moment(), moment(5.0, fell=True)]).ended == judge.FELL
    assert judged([moment(), moment(-9.0)], -EAST).ended == judge.REACHED
    # 10 s are 500 control steps; a creep of less than 1 cm isn't progress.
    still = [moment(), moment(1.0)] + [moment(1.009)] * 500
    assert judged(still[:-1]).ended == judge.RUNNING
    assert judged(still).ended == judge.STUCK
    assert judged([*still[:400], moment(1.02), *still[400:]]).ended == judge.RUNNING


def test_progress_is_the_largest_and_ignores_a_fall():
    tally = judged(
        [moment(), moment(2.0, work=3.0), moment(1.0, work=4.0), moment(np.nan, work=np.nan, fell=True)]
    )
    assert (tally.progress, tally.work, tally.steps, tally.ended) == (2.0, 7.0, 3, judge.FELL)


def test_heading_is_counted_without_wrapping():
    turns = [moment(yaw=math.remainder(0.5 * i, 2 * math.pi)) for i in range(20)]
    assert judged(turns).turned == pytest.approx(0.5 * 19)


def test_swings_are_measured_from_lift_off():
    stance, up, top = moment(feet=0.125), moment(phases=0.5, feet=0.15), moment(phases=1.0, feet=0.205)
    landed = moment(feet=0.175)
    tally = judged([stance, up, top, landed, up, landed])
    # Lift-off at 0.125 and peak at 0.205: 0.08. Then lift-off at 0.175; the foot only sinks, by the end to 0.175: 0.
    assert tally.swings == 8 and tally.lift == pytest.approx(4 * 0.08 + 4 * 0.0)
    assert tally.unsafe == 0


@pytest.mark.parametrize(("low", "unsafe"), [(0.0, 0), (-0.2, 0), (-0.5, 4)])
def test_footholds_near_a_gap_are_unsafe(low, unsafe):
    assert judged([moment(phases=0.5), moment(low=low)]).unsafe == unsafe


def test_judge_is_the_same_under_jax():
    rng, step = np.random.default_rng(0), jax.jit(judge.update, static_argnums=4)
    x = np.cumsum(rng.normal(0.01, 0.02, 300))
    walk = [
        moment(
            x[i],
            yaw=rng.uniform(-3, 3),
            phases=rng.uniform(-3, 3),
            feet=rng.uniform(0, 0.2),
            work=rng.uniform(),
        )
        for i in range(300)
    ]
    numpy, to_jax = judged(walk), lambda m: jax.tree.map(jnp.asarray, m)
    tally = judge.begin(to_jax(walk[0]))
    for m in walk[1:]:
        tally = step(tally, to_jax(m), jnp.asarray(ORIGIN), jnp.asarray(EAST), DT)
    for name, value in numpy._asdict().items():
        np.testing.assert_allclose(getattr(tally, name), value, rtol=1e-4, atol=1e-5, err_msg=name)


# -- figures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Wilson (1927): (p + z²/2n ± z √(p(1-p)/n + z²/4n²)) / (1 + z²/n) with z = 1.96; 10 of 10: 10 / (10 + 3.8415).
    [(10, 10, 0.7225, 1.0), (0, 10, 0.0, 0.2775), (9, 18, 0.2903, 0.7097), (5, 10, 0.2366, 0.7634)],
)
def test_wilson_interval(successes, trials, low, high):
    found = evaluate.wilson(successes, trials)
    assert found["mean"] == successes / trials
    assert (found["low"], found["high"]) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))


def test_summary_adds_up():
    start = judge.begin(moment())
    ends = [(judge.REACHED, 5.02, 100.0), (judge.FELL, 1.0, 50.0), (judge.STUCK, 2.0, 50.0)]
    tallies = [
        start._replace(
            ended=e, progress=p, work=w, steps=500.0, swings=10.0, lift=0.5, unsafe=1.0, turned=-0.1
        )
        for e, p, w in ends
    ]
    about = {"control_dt": DT, "method": "ours", "commit": "abc"}
    found = evaluate.summary(evaluate.Options(policy="x", episodes=3), about, tallies)
    # 5 (capped) + 1 + 2 = 8 m with 200 J; 30 s.
    assert found["distance_m"] == {
        "mean": pytest.approx(8 / 3),
        "std": pytest.approx(1.69967, abs=1e-5),
        "min": 1.0,
    }
    assert (found["energy_j_per_m"], found["swing_height_m"]) == (pytest.approx(25.0), pytest.approx(0.05))
    assert (found["unsafe_foothold_share"], found["heading_drift_rad"]) == (
        pytest.approx(0.1),
        pytest.approx(0.1),
    )
    assert found["speed_m_s"] == pytest.approx(8 / 30)
    assert found["ended_by"] == {"reached": 1, "fell": 1, "stuck": 1}
    assert [d["success_rate"] for d in found["by_direction"]] == [1.0, 0.0, 0.0]
    json.dumps(found, allow_nan=False)
    text = evaluate.table(found)
    assert "2.667 m" in text and "poles, difficulty 0.8, mjx, 3 episodes" in text


def test_knees_are_those_of_training_unless_asked_otherwise(file, tmp_path):
    """A robot let down onto its knees has fallen, or stands on them."""
    metadata = Controller(file).metadata
    assert evaluate.what_knees_do(metadata, "training") == evaluate.what_knees_do({}, "training") == "fall"
    assert evaluate.what_knees_do({"training": {"env": {"knee_contact": True}}}, "training") == "touch"
    for knees, fallen in (("fall", True), ("touch", False)):
        config = evaluate.walked_in(metadata, knees)
        simulation = Simulation(Controller(file), terrains.make_terrain("flat", "paper", 0), config)
        robot, data = simulation.robot, simulation.data
        # Thighs hang down, shanks are folded up: what is lowest are the knees.
        data.qpos[robot.qpos_ids] = np.tile([0.0, 0.0, 2.3], 4)
        data.qpos[2] = 0.2115 + 0.015
        assert simulation.fell() == fallen
        desired, lowest = data.qpos[robot.qpos_ids].copy(), []
        for _ in range(150):
            simulation.substep(desired, simulation.controller.damping)
            lowest.append(data.xpos[robot.knee_ids, 2].min())
        # Half of a second later they carry the robot, or it has sunk through the ground to its feet.
        assert (min(lowest) > 0.01) == (not fallen)


def test_nothing_walked_is_no_division_by_zero():
    tally = judge.begin(moment())._replace(ended=judge.FELL, steps=1.0)
    found = evaluate.summary(evaluate.Options(), {"control_dt": DT, "method": "ours", "commit": ""}, [tally])
    assert found["energy_j_per_m"] is None and found["swing_height_m"] is None
    assert "energy            -" in evaluate.table(found)


def test_directions_are_the_papers_in_turn():
    found = [math.atan2(*evaluate.direction(k)[::-1]) for k in range(7)]
    quarter = math.pi / 4
    np.testing.assert_allclose(
        np.cos(found), np.cos([0, quarter, -quarter, -math.pi, -5 * quarter, -3 * quarter, 0])
    )
    np.testing.assert_allclose(
        np.sin(found), np.sin([0, quarter, -quarter, -math.pi, -5 * quarter, -3 * quarter, 0]), atol=1e-12
    )


def test_terrains_are_not_those_of_training():
    assert envs.EnvConfig().terrain.seed < evaluate.FIRST_SEED


# -- MuJoCo C --------------------------------------------------------------------------------------------------------


def flat(**options):
    return evaluate.Options(**{"terrain": "flat", "engine": "mujoco", "episodes": 2, **options})


def test_mujoco_walks_and_writes_what_it_found(file, tmp_path, capsys):
    out = tmp_path / "result.json"
    evaluate.main([f"policy={file}", "terrain=flat", "engine=mujoco", "episodes=2", "seed=3", f"json={out}"])
    found = json.loads(out.read_text())
    assert found["terrain"] == "flat" and found["engine"] == "mujoco" and found["difficulty"] == 0.8
    assert found["episodes"] == 2 and found["seed"] == 3 and found["policy"] == str(file)
    assert sum(found["ended_by"].values()) == 2 and 0.02 < found["swing_height_m"] < 0.14
    printed = capsys.readouterr().out
    assert "episode 0: " in printed and "success" in printed
    assert os.listdir(tmp_path) == ["result.json"]


def test_mujoco_repeats_itself(file):
    first, second = (evaluate.mujoco_walk(flat(noise=True), file, 1).tally for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_robot_stands_at_rest_on_command_zero(file):
    controller = Controller(file)
    simulation = Simulation(
        controller, terrains.make_terrain("flat", 0.0, 0), training_env(controller.metadata)
    )
    for _ in range(50):
        moment = simulation.step(np.zeros(2))
    assert np.linalg.norm(moment.position) < 0.02 and abs(moment.yaw) < 0.02 and not moment.fell
    np.testing.assert_allclose(moment.feet, 0.025, atol=0.004)  # the spheres' radius
    np.testing.assert_array_equal(moment.ground, 0.0)


def test_a_robot_on_its_belly_or_side_has_fallen(file):
    controller = Controller(file)
    simulation = Simulation(
        controller, terrains.make_terrain("flat", 0.0, 0), training_env(controller.metadata)
    )
    assert not simulation.fell()
    simulation.data.qpos[2] = simulation.robot.trunk_half_size[2] - 0.01
    assert simulation.fell()
    simulation.data.qpos[2] = 1.0
    assert not simulation.fell()
    simulation.data.qpos[3:7] = [math.cos(0.6), math.sin(0.6), 0.0, 0.0]  # 1.2 rad: cosine 0.36
    assert simulation.fell()


def test_timestep_must_divide_the_control_period(file):
    with pytest.raises(ValueError, match="timestep=0.003 doesn't divide"):
        evaluate.mujoco_walk(flat(timestep=0.003), file, 0)


def test_noise_has_the_configured_size():
    noise, random = envs.RandomisationConfig(), np.random.default_rng(0)
    exact = {"orientation": np.array([1.0, 0, 0, 0])}
    exact |= {"angular_velocity": np.zeros(3), "joint_position": np.zeros(12), "joint_velocity": np.zeros(12)}
    many = [noisy(exact, noise, random) for _ in range(4000)]
    size = {name: np.std([m[name] for m in many]) for name in exact}
    assert size["joint_position"] == pytest.approx(noise.joint_position_noise, rel=0.03)
    assert size["joint_velocity"] == pytest.approx(noise.joint_velocity_noise, rel=0.03)
    assert size["angular_velocity"] == pytest.approx(noise.angular_velocity_noise, rel=0.03)
    # A small turn by an angle about x is half of it in the quaternion's x.
    assert np.std([m["orientation"][1] for m in many]) == pytest.approx(0.5 * noise.tilt_noise, rel=0.05)


# -- MJX -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_mjx_walks_and_counts_the_same_things(file):
    options = evaluate.Options(policy=str(file), terrain="flat", episodes=2)
    lines = []
    found = evaluate.evaluate(options, lines.append)
    assert found["episodes"] == 2 == sum(found["ended_by"].values())
    assert 0.02 < found["swing_height_m"] < 0.14 and "2 of 2 episodes ended" in lines[-1]
    some = judge.begin(moment())._replace(steps=1.0, ended=judge.FELL)
    names = evaluate.summary(options, {"control_dt": DT, "method": "", "commit": ""}, [some])
    assert found.keys() == names.keys()


@pytest.mark.slow
def test_engines_are_the_same_at_the_same_settings(tmp_path):
    """With MJX's timestep and as many Newton iterations, MuJoCo C walks the same steps; so does all around it."""
    from tlq import batch
    from tlq.runtime import load_policy

    file = trained(spread=0.02).export(tmp_path / "policy.npz")
    controller, direction = Controller(file), evaluate.direction(1)
    config, policy = training_env(controller.metadata), load_policy(file)
    sizes = terrains.TerrainConfig(kind="flat", num_terrains=2, seed=evaluate.FIRST_SEED)
    env = envs.make(batch.evaluation_config(config, sizes, 0.8, noise=False))
    simulation = Simulation(controller, terrains.make_terrain("flat", "paper", 0), config, timestep=0.005)
    simulation.model.opt.iterations = env.config.solver_iterations
    simulation.model.opt.ls_iterations = env.mj_model.opt.ls_iterations

    key, towards = jax.random.PRNGKey(0), jnp.asarray(direction, jnp.float32)
    state = jax.jit(lambda: batch._begin(env, key, jnp.int32(1), towards, jnp.float32(0.5 * np.pi)))()
    tally, memory = judge.begin(batch._moment(env, state.pipeline_state)), jnp.zeros(policy.memory_size)
    here = judge.begin(simulation.moment())
    step = jax.jit(lambda *carry: batch._step(policy, env, *carry))
    for _ in range(15):
        state, memory, tally = step(state, memory, tally)
        here = judge.update(here, simulation.step(direction), np.zeros(2), direction, DT)
        np.testing.assert_allclose(simulation.data.qpos, state.pipeline_state.qpos, atol=2e-3)
        np.testing.assert_allclose(controller.memory, memory, atol=2e-3)
    # Work is summed over substeps here, and taken from the last one there.
    for name, value in here._replace(work=tally.work)._asdict().items():
        np.testing.assert_allclose(getattr(tally, name), value, atol=2e-3, err_msg=name)


# -- command line ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["terrain=pole"], "unknown terrain 'pole' .did you mean poles.*; choose one of flat, blocks"),
        (["engine=bullet"], "unknown engine 'bullet'; choose one of mjx, mujoco"),
        (["episode=3"], "unknown setting 'episode' .did you mean episodes"),
        (["episodes=two"], "episodes=two isn't a whole number"),
        (["knees=bend"], "unknown knees 'bend'; choose one of training, fall, touch"),
        (["noise=maybe"], "noise=maybe isn't true or false"),
        (["poles"], "'poles' isn't of the form key=value"),
        ([], "policy= is missing"),
        (
            ["policy=x", "difficulty=hard"],
            r"unknown difficulty 'hard'; choose a number in \[0, 1\] or 'paper'",
        ),
        (["policy=x", "difficulty=1.5"], "unknown difficulty '1.5'"),
        (["policy=x", "episodes=0"], "episodes=0 must be at least 1"),
        (["policy=x", "seed=-1"], "seed=-1 must be 0 or more"),
        (["policy=x", "json=/no/where/x.json"], "there is no folder /no/where"),
        (["policy=x"], "policy=x: no such policy; choose a policy file or a run folder"),
    ],
)
def test_wrong_command_lines_name_what_is_right(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate.main(arguments)


def test_numbers_are_read_as_people_write_them():
    options = parse(
        evaluate.Options, ["policy=x", "episodes=1e2", "seed=20000", "noise=True", "timestep=1e-3"]
    )
    assert (options.episodes, options.seed, options.noise, options.timestep) == (100, 20000, True, 0.001)


def test_settings_that_programs_share_come_last():
    names = [field.name for field in cli.settings(evaluate.Options)]
    assert names[:2] == ["policy", "terrain"]
    assert names[-5:] == ["perception", "drift", "latency", "missing", "range_noise"]


def test_policies_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "POLICIES", tmp_path)
    (tmp_path / "index.json").write_text('{"poles": {"file": "poles.npz"}, "stairs": {"file": "s.npz"}}')
    assert cli.find_policy("poles") == tmp_path / "poles.npz"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "policy.npz").touch()
    assert cli.find_policy(str(tmp_path / "run")) == tmp_path / "run" / "policy.npz"
    with pytest.raises(UsageError, match="policy=pole: .*, or one of poles, stairs"):
        cli.find_policy("pole")


def test_errors_are_one_line_and_exit_code_2(tmp_path):
    command = [sys.executable, "-m", "tlq.evaluate", f"policy={tmp_path}", "terrain=flat"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        f"error: policy={tmp_path}: no such policy; choose a policy file or a run folder that holds one"
    )
