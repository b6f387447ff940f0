"""A run killed at any moment, and resumed, ends as the one that was left alone."""

import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tlq.checkpoint import read_arrays

ITERATIONS, KILLS = 60, 10
CODE = """
import dataclasses, sys
from tests.tlq.test_training import CONFIG, STEPS
from tests.tlq.toy import ToyEnv
from tlq import config, training
config.use_cache(sys.argv[3])
# A checkpoint after every iteration: most of the time something is being written.
settings = dataclasses.replace(CONFIG, steps=int(sys.argv[2]) * STEPS, run=sys.argv[1], checkpoint_every=0.0)
training.train(dataclasses.replace(settings, resume=sys.argv[4] == "resume"), ToyEnv(length=5), heights=100)
"""


def start(folder, cache, resume):
    command = [sys.executable, "-c", CODE, str(folder), str(ITERATIONS), str(cache)]
    return subprocess.Popen(
        [*command, "resume" if resume else "new"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"XLA_FLAGS": "", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"},
    )


def finished(process):
    out, _ = process.communicate(timeout=900)
    assert process.returncode == 0, out
    return out


def unfinished(folder):
    return list((folder / "checkpoints").glob("*.orbax-checkpoint-tmp*"))


@pytest.mark.slow
def test_killed_ten_times_the_run_is_the_uninterrupted_one(tmp_path):
    cache, whole, parts = tmp_path / "cache", tmp_path / "whole", tmp_path / "parts"
    finished(start(whole, cache, resume=False))
    rng, torn = random.Random(0), 0
    for kill in range(KILLS):
        process = start(parts, cache, resume=(parts / "config.yaml").exists())
        if kill == 0:
            time.sleep(rng.uniform(1.0, 6.0))  # before there is anything to go on with
        else:
            for line in process.stdout:
                if "steps " in line and "k/s" in line:
                    break
            deadline = time.monotonic() + rng.uniform(0.0, 1.0)
            # Every other time while a checkpoint is half written.
            while process.poll() is None and time.monotonic() < deadline + 10:
                if time.monotonic() > deadline and (kill % 2 or unfinished(parts)):
                    break
                time.sleep(0.001)
        assert process.poll() is None, "the run was over before it could be killed"
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
        torn += bool(unfinished(parts))
    assert torn > 0
    finished(start(parts, cache, resume=True))
    expected, found = (read_arrays(folder / "checkpoints") for folder in (whole, parts))
    assert expected.keys() == found.keys() and int(found["iteration"]) == ITERATIONS
    for name, x in expected.items():
        np.testing.assert_array_equal(x, found[name], err_msg=name)


FULL = """
import resource
from tlq import cli, training
save = training.save

def full_after_the_first(config, learner, state, checkpoints, logger):
    if int(state.iteration) > 1:  # every file that grows beyond a kilobyte meets the end of the disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
    save(config, learner, state, checkpoints, logger)

training.save = full_after_the_first
train = training.train

def answered(*arguments, **settings):
    try:
        train(*arguments, **settings)
    except training.TrainingFailed as error:
        cli.fail(error, at_once=True)

training.train = answered
"""


@pytest.mark.slow
def test_a_full_disk_ends_the_run_and_spares_what_was_saved(tmp_path):
    folder, cache = tmp_path / "run", tmp_path / "cache"
    code = CODE.replace("training.train(", FULL + "training.train(")
    command = [sys.executable, "-c", code, str(folder), "3", str(cache), "new"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert "can't write checkpoint 2" in line and "checkpoint 1 is as it was" in line
    assert int(read_arrays(folder / "checkpoints")["iteration"]) == 1
    finished(start(folder, cache, resume=True))
    assert int(read_arrays(folder / "checkpoints")["iteration"]) == ITERATIONS
