"""The paper's Table I beside ours: travel distance of the three methods on four terrains at level `paper`.

    python -m tlq.table1                                    # 360 episodes a cell in MJX and in MuJoCo C: hours
    python -m tlq.table1 episodes=36 engine=mjx json=FILE markdown=FILE picture=FILE.png

Each cell takes the policies of policies/index.json: the method's specialist on that terrain, and its generalist
(trained on `mixed`). A cell without a policy stays empty. With json=FILE results are kept as they come, and the same
command goes on where it was stopped.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import envs
from tlq import cli, evaluate
from tlq.cli import option
from tlq.files import whole

TERRAINS = ("blocks", "stairs", "stepping_stones", "poles")
PAPER = {
    "ours": (4.983, 4.951, 4.954, 4.930),
    "fixed_height": (4.911, 4.859, 1.782, 1.924),
    "blind": (4.948, 4.960, 1.539, 1.906),
}
"""Mean distance (m) in the paper's Table I on each of `TERRAINS`, of 18 runs."""
KINDS = ("specialist", "generalist")


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    episodes: int = option(360, "episodes of each cell")
    engine: str = option("both", "physics", choices=lambda: ("both", *evaluate.ENGINES))
    seed: int = option(1000, "of the terrains; training and development used others")
    workers: int = option(1, "processes for engine=mujoco")
    json: str = option("", "file that keeps the results")
    markdown: str = option("", "file for the table")
    picture: str = option("", "PNG file for the table as bars")


def policies() -> dict[tuple[str, str, str], str]:
    """Names of the policies that come with tlq by (method, kind, terrain); generalists count for every terrain, of
    several specialists the first in the index.
    """
    found: dict[tuple[str, str, str], str] = {}
    for name, about in json.loads((cli.POLICIES / "index.json").read_text()).items():
        if about["terrain"] == "mixed":
            found |= {(about["method"], "generalist", terrain): name for terrain in TERRAINS}
        elif about["terrain"] in TERRAINS:
            found.setdefault((about["method"], "specialist", about["terrain"]), name)
    return found


def measure(options: Options) -> dict[str, dict[str, Any]]:
    """Results of `tlq.evaluate` by 'policy/terrain/engine/episodes/seed', without those of single episodes."""
    path = Path(options.json) if options.json else None
    results: dict[str, Any] = json.loads(path.read_text()) if path and path.exists() else {}
    engines = evaluate.ENGINES if options.engine == "both" else (options.engine,)
    cells = sorted({(name, terrain) for (_, _, terrain), name in policies().items()})
    for name, terrain in cells:
        for engine in engines:
            key = f"{name}/{terrain}/{engine}/{options.episodes}/{options.seed}"
            if key in results:
                continue
            print(f"policy {name} on {terrain} in {engine}", flush=True)
            one = evaluate.Options(
                policy=name,
                terrain=terrain,
                engine=engine,
                episodes=options.episodes,
                seed=options.seed,
                workers=options.workers,
            )
            results[key] = {k: v for k, v in evaluate.evaluate(one, lambda _: None).items() if k != "runs"}
            if path:
                with whole(path) as temporary:
                    temporary.write_text(json.dumps(results, indent=1) + "\n")
    return results


def cell(result: dict[str, Any] | None) -> str:
    """One result in words: mean ± standard deviation, success and its 95 % interval."""
    if result is None:
        return "-"
    distance, success = result["distance_m"], result["success_rate"]
    low, high = (math.floor(1000 * success[end]) / 10 for end in ("low", "high"))
    return f"{distance['mean']:.3f} ± {distance['std']:.3f}, {100 * success['mean']:.1f} % ({low:.1f}..{high:.1f})"


def table(options: Options, results: dict[str, dict[str, Any]]) -> str:
    """The table in Markdown: distance (m) and share of the episodes that reached 5 m, with its 95 % interval."""
    found = policies()
    lines = [
        "| method | policy | engine | " + " | ".join(t.replace("_", " ") for t in TERRAINS) + " |",
        "| --- | --- | --- |" + " --- |" * len(TERRAINS),
    ]
    for method in envs.METHODS:
        lines.append(
            f"| {method} | the paper's | PyBullet | " + " | ".join(f"{x:.3f}" for x in PAPER[method]) + " |"
        )
        for kind in KINDS:
            for engine in evaluate.ENGINES:
                row = []
                for terrain in TERRAINS:
                    name = found.get((method, kind, terrain))
                    key = f"{name}/{terrain}/{engine}/{options.episodes}/{options.seed}"
                    row.append(cell(results.get(key)))
                if set(row) != {"-"}:
                    lines.append(f"| {method} | {kind} | {engine} | " + " | ".join(row) + " |")
    return "\n".join(lines)


def draw(options: Options, results: dict[str, dict[str, Any]], path: str) -> None:
    """Bars of the mean distance, by terrain; the paper's hollow."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    found, engine = policies(), "mujoco" if options.engine == "both" else options.engine
    figure, axes = plt.subplots(1, len(TERRAINS), figsize=(13, 3.2), sharey=True, constrained_layout=True)
    for column, (axis, terrain) in enumerate(zip(axes, TERRAINS, strict=True)):
        for i, method in enumerate(envs.METHODS):
            axis.bar(3 * i, PAPER[method][column], 0.8, fill=False)
            for j, kind in enumerate(KINDS):
                key = f"{found.get((method, kind, terrain))}/{terrain}/{engine}/{options.episodes}/{options.seed}"
                if key in results:
                    distance = results[key]["distance_m"]
                    axis.bar(
                        3 * i + 0.8 * (j + 1), distance["mean"], 0.8, yerr=distance["std"], color=f"C{j}"
                    )
        axis.set_title(terrain.replace("_", " "), fontsize=10)
        axis.set_xticks([3 * i + 0.8 for i in range(3)], envs.METHODS, fontsize=8)
    axes[0].set_ylabel(f"distance (m), {engine}; hollow: the paper")
    with whole(path) as temporary:
        figure.savefig(temporary, dpi=100)
    plt.close(figure)


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "json", "markdown", "picture")
    if options.episodes < 1:
        raise ValueError(f"episodes={options.episodes} must be at least 1")
    results = measure(options)
    text = table(options, results)
    print(text)
    if options.markdown:
        with whole(options.markdown) as temporary:
            temporary.write_text(text + "\n")
    if options.picture:
        draw(options, results, options.picture)


if __name__ == "__main__":
    cli.run(main)
