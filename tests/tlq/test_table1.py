"""Table I: which policies stand in which cell, and that a stopped measurement goes on."""

import json

import pytest

from tlq import table1

INDEX = {
    "poles": {"terrain": "poles", "method": "ours"},
    "mixed": {"terrain": "mixed", "method": "ours"},
    "mixed-blind": {"terrain": "mixed", "method": "blind"},
    "flat": {"terrain": "flat", "method": "ours"},
    "poles-for-something-else": {"terrain": "poles", "method": "ours"},
}


def result(options):
    mean = 5.0 if options.engine == "mjx" else 4.9
    return {
        "distance_m": {"mean": mean, "std": 0.2, "min": 1.0},
        "success_rate": {"mean": 0.95, "low": 0.90111, "high": 0.97999},
        "runs": [1, 2, 3],
    }


@pytest.fixture
def calls(monkeypatch, tmp_path):
    (tmp_path / "index.json").write_text(json.dumps(INDEX))
    monkeypatch.setattr(table1.cli, "POLICIES", tmp_path)
    found = []

    def evaluate(options, report):
        found.append(options)
        return result(options)

    monkeypatch.setattr(table1.evaluate, "evaluate", evaluate)
    return found


def test_cells_and_what_is_kept(calls, tmp_path, capsys):
    kept, text = tmp_path / "kept.json", tmp_path / "table.md"
    arguments = ["episodes=36", f"json={kept}", f"markdown={text}", f"picture={tmp_path / 'bars.png'}"]
    table1.main(arguments)
    # One specialist on its terrain, two generalists on four, in two engines.
    assert len(calls) == 2 * (1 + 4 + 4) and {c.terrain for c in calls} == set(table1.TERRAINS)
    assert all(c.episodes == 36 and c.seed == 1000 for c in calls)
    lines = text.read_text().splitlines()
    assert lines[2] == "| ours | the paper's | PyBullet | 4.983 | 4.951 | 4.954 | 4.930 |"
    assert lines[3] == "| ours | specialist | mjx | - | - | - | 5.000 ± 0.200, 95.0 % (90.1..97.9) |"
    assert [line.split(" | ")[:3] for line in lines[4:7]] == [
        ["| ours", "specialist", "mujoco"],
        ["| ours", "generalist", "mjx"],
        ["| ours", "generalist", "mujoco"],
    ]
    assert sum(line.startswith("| blind | generalist") for line in lines) == 2
    assert sum(line.startswith("| fixed_height") for line in lines) == 1  # the paper's alone
    assert (tmp_path / "bars.png").stat().st_size > 1000
    assert "runs" not in json.loads(kept.read_text())["poles/poles/mjx/36/1000"]
    # Again: nothing is measured twice. With one cell lost, that one is.
    calls.clear()
    table1.main(arguments)
    assert not calls
    results = json.loads(kept.read_text())
    del results["mixed/stairs/mujoco/36/1000"]
    kept.write_text(json.dumps(results))
    table1.main(arguments)
    assert [(c.policy, c.terrain, c.engine) for c in calls] == [("mixed", "stairs", "mujoco")]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["episodes=0"], "episodes=0 must be at least 1"),
        (["engine=bullet"], "unknown engine 'bullet'; choose one of both, mjx, mujoco"),
        (["json=/no/where/x.json"], "there is no folder /no/where"),
    ],
)
def test_wrong_settings_name_what_is_right(calls, arguments, message):
    with pytest.raises(ValueError, match=message):
        table1.main(arguments)
    assert not calls
