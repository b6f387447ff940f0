"""The safety monitor: its network against Flax, its file, its decisions, and what becomes of robots that have one."""

import json

import flax.linen as nn
import numpy as np
import pytest

from tests.tlq.monitors import made, network
from tests.tlq.test_supervisor import FORWARD, STILL, Rig
from tlq import cli, evaluate, judge, monitor
from tlq.monitor import Decision, Monitor, MonitorFileError
from tlq.runtime import Controller
from tlq.supervisor import Mode, Supervisor

ALWAYS, NEVER = 20.0, -20.0  # logits


@pytest.fixture(scope="module")
def policy():
    """One that walks; none has to be made."""
    return cli.POLICIES / "flat.npz"


@pytest.fixture(scope="module")
def file(policy, tmp_path_factory):
    return made(tmp_path_factory.mktemp("monitor") / "monitor.npz", policy, spread=0.05)


# -- the network -----------------------------------------------------------------------------------------------------


def test_the_network_is_flax_s(policy):
    net = network(policy, spread=0.3)._replace(scale=np.float32(0.7), shift=np.float32(-0.2))
    x = np.random.default_rng(1).normal(0.0, 3.0, (5, len(net.mean))).astype(np.float32)

    class Reference(nn.Module):
        @nn.compact
        def __call__(self, x):
            hidden = nn.elu(nn.Dense(8)(x))
            return nn.Dense(1)(hidden)

    layers = zip(net.kernels, net.biases, strict=True)
    params = {f"Dense_{i}": {"kernel": k, "bias": b} for i, (k, b) in enumerate(layers)}
    normal = np.clip((x - net.mean) / net.std, -5.0, 5.0)
    wanted = 0.7 * np.asarray(Reference().apply({"params": params}, normal))[:, 0] - 0.2
    np.testing.assert_allclose(monitor.logit(net, x), wanted, rtol=1e-4, atol=1e-4)


def test_a_file_gives_back_what_was_saved(policy, file):
    metadata, found = monitor.load_monitor(file)
    for name, wanted in network(policy, spread=0.05)._asdict().items():
        several = isinstance(wanted, tuple)
        pairs = (
            zip(getattr(found, name), wanted, strict=True) if several else [(getattr(found, name), wanted)]
        )
        for a, b in pairs:
            np.testing.assert_array_equal(a, b)
    assert metadata["horizon"] == 0.8 and metadata["layers"] == [len(found.mean), 8, 1]


def test_probability_is_of_what_the_controller_saw_and_did(policy, file):
    controller, watch = Controller(policy), Monitor(file, policy)
    sensors = controller.example_sensors()
    controller.step(sensors, np.full((4, 25), -0.3), FORWARD)
    parts = (controller.observation, controller.memory, controller.action)
    x = float(monitor.logit(watch.network, np.concatenate(parts)))
    assert watch.probability(controller) == pytest.approx(1.0 / (1.0 + np.exp(-x)), rel=1e-5)


# -- the file --------------------------------------------------------------------------------------------------------


def changed(file, tmp_path, **arrays):
    with np.load(file) as stored:
        kept = {name: stored[name] for name in stored.files}
    np.savez(tmp_path / "changed.npz", **{k: v for k, v in (kept | arrays).items() if v is not None})
    return tmp_path / "changed.npz"


def about(file, **changes):
    with np.load(file) as stored:
        return np.array(json.dumps(json.loads(str(stored["metadata"])) | changes))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"metadata": np.array("{")}, "its metadata isn't JSON"),
        ({"metadata": np.array("[]")}, "not a monitor's file of this program"),
        ({"metadata": None}, "not a monitor file: it has no metadata"),
        ({"kernel_1": None}, r"kernel_1 must be float32 \(8, 1\)"),
        ({"bias_0": np.zeros(7, np.float32)}, r"bias_0 must be float32 \(8,\)"),
        ({"bias_0": np.zeros(8)}, r"bias_0 must be float32 \(8,\)"),
        ({"bias_0": np.full(8, np.nan, np.float32)}, "bias_0 holds values that are not finite"),
        ({"platt": np.array([{}, {}])}, "damaged"),
    ],
)
def test_damaged_files_are_refused(file, tmp_path, arrays, message):
    with pytest.raises(MonitorFileError, match=message):
        monitor.load_monitor(changed(file, tmp_path, **arrays))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "format version 2; this program reads version 1"),
        ({"format": "tlq-policy"}, "not a monitor's file of this program"),
        ({"stop": "high"}, r"stop must be a number in \[0, 1\]"),
        ({"stop": float("nan")}, r"stop must be a number in \[0, 1\]"),
        ({"go": 0.9}, "go must not be larger than stop"),
        ({"layers": [3, 2]}, "the last layer must have size 1"),
        ({"layers": "many"}, "layers must be a list of sizes"),
        ({"policy_sha256": None}, "policy_sha256 is missing"),
    ],
)
def test_metadata_is_checked(file, tmp_path, changes, message):
    with pytest.raises(MonitorFileError, match=message):
        monitor.load_monitor(changed(file, tmp_path, metadata=about(file, **changes)))


def test_other_files_are_refused_in_one_line(policy, file, tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "half.npz").write_bytes(file.read_bytes()[:1000])
    for path, message in (
        (tmp_path / "none.npz", "no monitor file at"),
        (tmp_path / "text.npz", "damaged"),
        (tmp_path / "half.npz", "damaged"),
        (policy, "not a monitor's file of this program"),
    ):
        with pytest.raises(MonitorFileError, match=message) as error:
            Monitor(path, policy)
        assert "\n" not in str(error.value)


def test_a_monitor_of_another_policy_is_refused(file):
    with pytest.raises(MonitorFileError, match="belongs to another policy than .*blocks.npz; fit one to it"):
        Monitor(file, cli.POLICIES / "blocks.npz")


# -- decisions -------------------------------------------------------------------------------------------------------


def decisions(decision, probabilities):
    return [bool(decision.step(p, 0.1)) for p in probabilities]


def test_an_alarm_stops_for_good():
    decision = Decision(0.5, 0.2, 0.0)
    assert decisions(decision, [0.1, 0.5, 0.51, 0.0, 0.0]) == [False, False, True, True, True]
    assert decision.alarms == 1
    decision.reset()
    assert decisions(decision, [0.3]) == [False]


def test_two_thresholds_and_a_time_before_it_goes_on():
    decision = Decision(0.5, 0.2, 0.3)
    # Between the thresholds nothing changes, either way; 0.3 s below `go` are three steps in a row.
    assert decisions(decision, [0.4, 0.6, 0.4, 0.1, 0.1, 0.3, 0.1, 0.1]) == [False] + 7 * [True]
    assert decisions(decision, [0.1, 0.4, 0.4, 0.6]) == [False, False, False, True]
    assert decision.alarms == 2


def test_what_is_no_number_is_an_alarm():
    assert decisions(Decision(1.0, 0.5, 0.0), [1.0, float("nan")]) == [False, True]


# -- robots ----------------------------------------------------------------------------------------------------------


def walked(policy, **options):
    asked = evaluate.Options(policy=str(policy), terrain="flat", engine="mujoco", noise=True, **options)
    return evaluate.mujoco_walk(asked, policy, 0)


def test_a_monitor_that_never_alarms_changes_nothing(policy, tmp_path, monkeypatch):
    monkeypatch.setattr(judge, "GOAL", 0.4)
    free = walked(policy)
    watched = walked(policy, monitor=str(made(tmp_path / "m.npz", policy, bias=NEVER)))
    for a, b in zip(free.tally, watched.tally, strict=True):
        np.testing.assert_array_equal(a, b)
    assert free.tally.ended == judge.REACHED and watched.alarms == 0 and 0 < watched.highest < 1e-8


def test_a_monitor_that_always_alarms_leads_to_standing(policy, tmp_path):
    watched = walked(policy, monitor=str(made(tmp_path / "m.npz", policy, bias=ALWAYS)))
    assert watched.tally.ended == judge.STUCK and watched.alarms == 1 and watched.stood >= evaluate.STOOD
    assert watched.tally.progress < 0.2  # walking, it gets 1.2 m far in this time


def test_the_robot_goes_on_after_a_while(policy, tmp_path):
    watch = Monitor(made(tmp_path / "m.npz", policy, bias=NEVER, resume=0.5), policy)
    controller = Controller(policy)
    watch.decision.step(1.0, 0.02)
    controller.step(controller.example_sensors(), np.full((4, 25), -0.3), FORWARD)
    # 0.5 s are 25 control periods, the last of which says that the robot goes on.
    assert [watch.step(controller) for _ in range(25)] == 24 * [True] + [False]


def test_danger_while_standing_keeps_it_standing(policy, tmp_path):
    watch = Monitor(made(tmp_path / "m.npz", policy, bias=ALWAYS, resume=0.1), policy)
    controller = Controller(policy)
    controller.step(controller.example_sensors(), np.full((4, 25), -0.3), FORWARD)
    assert all(watch.step(controller) for _ in range(25)) and watch.decision.alarms == 1


def test_results_tell_of_the_monitor(policy, tmp_path, capsys):
    file, out = made(tmp_path / "m.npz", policy, bias=ALWAYS), tmp_path / "result.json"
    arguments = [f"policy={policy}", "terrain=flat", "engine=mujoco", "episodes=1", f"json={out}"]
    evaluate.main([*arguments, f"monitor={file}"])
    found = json.loads(out.read_text())
    assert found["monitor"]["episodes_with_alarm"] == 1 and found["monitor"]["fell_after_alarm"] == 0
    assert found["runs"][0]["alarms"] == 1 and found["runs"][0]["stood_s"] == pytest.approx(3.0, abs=0.03)
    assert "1 episodes with an alarm, 0 of them fell" in capsys.readouterr().out


def test_wrong_names_and_engines_are_refused(policy):
    with pytest.raises(
        ValueError, match="monitor=pole: no such monitor; choose a monitor's file, or one of none"
    ):
        cli.find_monitor("pole")
    with pytest.raises(ValueError, match="monitor=x needs engine=mujoco"):
        evaluate.main([f"policy={policy}", "terrain=flat", "monitor=x"])


class Watched(Rig):
    """The supervisor's rig, with a monitor."""

    def __init__(self, policy, file):
        super().__init__(policy)
        self.supervisor = Supervisor(Controller(policy), monitor=Monitor(file, policy))


def test_the_supervisor_stands_while_the_monitor_says_so(policy, tmp_path):
    rig = Watched(policy, made(tmp_path / "m.npz", policy, bias=ALWAYS))
    rig.step()
    state = rig.supervisor.controller.state
    for _ in range(30):
        rig.step()
        state = rig.supervisor.controller.state
        assert rig.mode is Mode.STOP and not np.asarray(rig.supervisor.controller.observation[:2]).any()
    assert rig.supervisor.stops == 1 and not state.gate > 0
    rig.step(None)  # without a message it doesn't walk either
    assert rig.mode is Mode.HOLD and not rig.supervisor.controller.state.gate > 0


def test_commanding_standing_ends_a_stop(policy, tmp_path):
    rig = Watched(policy, made(tmp_path / "m.npz", policy, bias=NEVER))
    rig.walk()
    controller, decision = rig.supervisor.controller, rig.supervisor.monitor.decision
    decision.step(1.0, 0.02)
    for _ in range(30):  # more than half a cycle
        rig.step()
    assert rig.mode is Mode.STOP and not controller.state.gate > 0
    rig.step(rig.message(command=STILL))
    assert rig.mode is Mode.STOP
    rig.walk()
    assert rig.supervisor.stops == 1 and not decision.standing


def test_a_supervisor_with_a_silent_monitor_is_one_without(policy, tmp_path):
    rigs = Rig(policy), Watched(policy, made(tmp_path / "m.npz", policy, bias=NEVER))
    for k in range(60):
        first, second = (rig.step(None if 20 < k < 26 else "good") for rig in rigs)
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("name", sorted(path.stem for path in (cli.POLICIES / "monitors").glob("*.npz")))
def test_monitors_that_come_with_tlq_belong_to_their_policies(name):
    """After another policy took the name: `python -m tlq.monitor_fit`, as in docs/safety.md."""
    metadata = Monitor(cli.find_monitor(name), cli.find_policy(name)).metadata
    results = json.loads((cli.POLICIES / "results" / f"{name}_monitor.json").read_text())
    assert {k: v for k, v in metadata.items() if k in results} == {
        k: v for k, v in results.items() if k in metadata
    }
    assert (
        metadata["policy"] == name
        and metadata["command"] in (cli.POLICIES.parent / "docs/safety.md").read_text()
    )
