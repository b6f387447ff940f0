"""The command line: what a user types becomes a typed configuration, or one line that names the choices."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

import envs
import tlq
from tlq import config as settings
from tlq.cli import UsageError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def registered():
    settings.register()


def parse(*arguments):
    """What train.py makes of a command line."""
    arguments = settings.clean(arguments)
    with initialize_config_dir(str(ROOT / "tlq/conf"), version_base=None):
        return settings.from_hydra(compose("train", arguments), arguments)


def test_each_default_stands_once():
    expected = dataclasses.replace(
        settings.default_config(), run="r", env=settings.replace(envs.EnvConfig(), "terrain.kind", "flat")
    )
    assert parse("run=r") == expected
    hash(parse("run=r"))  # all tuples, no lists


def test_what_users_type():
    config = parse(
        "terrain=poles", "method=blind", "steps=2e6", "num_envs=1_024", "seed=3", "ppo.entropy=0.005"
    )
    assert (config.env.terrain.kind, config.env.method) == ("poles", "blind")
    assert (config.steps, config.num_envs, config.seed, config.ppo.entropy) == (2_000_000, 1024, 3, 0.005)
    assert config.run.startswith("runs/poles-blind-20")
    nested = parse(
        "env.curriculum.depth=[0.1,0.2]",
        "env.curriculum.difficulty=[0,1]",
        "env.terrain.stairs.fixed_rise=0.1",
        "policy.critic=[8]",
    )
    assert nested.env.curriculum.depth == (0.1, 0.2)
    assert nested.env.terrain.stairs.fixed_rise == 0.1
    assert nested.policy.critic == (8,)


@pytest.mark.parametrize(
    ("argument", "answer"),
    [
        ("terrain=pole", r"unknown terrain 'pole' \(did you mean poles\?\); choose one of flat, .*, mixed"),
        (
            "method=blid",
            r"unknown method 'blid' \(did you mean blind\?\); choose one of ours, fixed_height, blind",
        ),
        (
            "nmu_envs=3",
            r"unknown setting 'nmu_envs' \(did you mean num_envs\?\); choose one of terrain, method, env",
        ),
        ("ppo.clipp=3", r"unknown setting 'ppo.clipp' \(did you mean clip\?\); choose one of unroll, epochs"),
        ("policy.memory=lstm", "unknown policy.memory 'lstm'; choose one of mingru, gru, none"),
        ("env.tg=3", "env.tg is a group of settings"),
        ("steps=2.5", "steps=2.5 isn't a whole number"),
        ("seed=many", "seed=many isn't a whole number"),
        ("ppo.clip=wide", "ppo.clip=wide isn't a number"),
        ("resume=perhaps", "resume=perhaps isn't true or false"),
        ("env.curriculum.depth=[deep]", "deep"),
        ("num_envs=0", "num_envs=0 must be from 1 to 4194304"),
        ("num_envs=1001", "num_envs=1001 must be a multiple of ppo.minibatches=8"),
        ("poles", "'poles' isn't of the form key=value, e.g. terrain=poles"),
        ("run=[", "."),
    ],
)
def test_a_mistake_is_answered_by_what_is_valid(argument, answer):
    with pytest.raises(UsageError, match=answer):
        parse(argument)


def test_flags_of_hydra_pass():
    assert settings.clean(["--cfg", "job", "-m", "seed=0,1e3"]) == ["--cfg", "job", "-m", "seed=0,1000"]


def test_a_saved_configuration_reads_back(tmp_path):
    config = parse("terrain=stairs", "run=r", "policy.critic=[8,8]")
    settings.save_config(config, tmp_path / "config.yaml")
    assert settings.load_config(tmp_path / "config.yaml") == config
    with pytest.raises(UsageError, match="unknown setting 'clipp'"):
        settings.build(type(config.ppo), {"clipp": 0.1})


def test_settings_that_an_older_run_does_not_name_are_as_they_were(tmp_path):
    path = tmp_path / "config.yaml"
    settings.save_config(parse("terrain=poles", "run=r"), path)
    assert settings.load_config(path).policy.foothold_head > 0
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if "foothold_head" not in line))
    assert settings.load_config(path).policy.foothold_head == 0


def test_resume_keeps_the_runs_settings_but_for_those_given(tmp_path):
    run = f"run={tmp_path}"
    settings.save_config(parse("terrain=poles", "ppo.clip=0.1", "steps=100", run), tmp_path / "config.yaml")
    config = parse(run, "resume=true", "steps=200")
    assert (config.env.terrain.kind, config.ppo.clip, config.steps, config.resume) == (
        "poles",
        0.1,
        200,
        True,
    )
    with pytest.raises(UsageError, match="has terrain=poles; for another one, start a run with init="):
        parse(run, "resume=true", "terrain=stairs")
    with pytest.raises(UsageError, match="holds no run to resume"):
        parse(f"run={tmp_path / 'nothing'}", "resume=true")


def test_make_gives_the_environment_with_the_same_defaults():
    env = tlq.make("flat", num_terrains=12, method="blind", tg__step_length=0.15)
    expected = envs.EnvConfig(method="blind")
    for key, value in {"terrain.kind": "flat", "terrain.num_terrains": 12, "tg.step_length": 0.15}.items():
        expected = settings.replace(expected, key, value)
    assert env.config == expected
    with pytest.raises(ValueError, match="unknown terrain 'pole'"):
        tlq.make("pole", num_terrains=12)
    with pytest.raises(UsageError, match="unknown setting 'step_len'"):
        tlq.make("flat", tg__step_len=0.15)


def test_train_py_answers_with_one_line_and_a_code():
    command = [sys.executable, str(ROOT / "train.py"), "terrain=pole"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode != 0
    assert len(done.stderr.splitlines()) == 1 and done.stderr.startswith("error: unknown terrain 'pole'")
