"""Fits a monitor to a policy: records walks in MuJoCo C, fits, calibrates, chooses thresholds, and says how good it is.

    python -m tlq.monitor_fit policy=poles terrain=poles difficulty=0.8 episodes=300 out=poles.npz

Each part has episodes of its own: some for the fit, others for stopping it early, others for calibration and
thresholds, and the rest, seen by none of these, for the figures. Letters: T control steps, F features, N steps of many
episodes.
"""

import dataclasses
import shlex
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import terrains
from tlq import calibration, episodes
from tlq.cli import check_folders, find_policy, option, parse, run
from tlq.episodes import Episode
from tlq.evaluate import FIRST_SEED, write_json
from tlq.export import commit
from tlq.files import whole
from tlq.monitor import GO, Decision, Network, fingerprint, logit, save_monitor
from tlq.runtime import load_policy

SHARES = {"fit": 0.55, "stopping": 0.15, "calibration": 0.15, "test": 0.15}
"""Of the episodes; every part gets at least one."""
HIDDEN = (64, 32)
BATCH = 512
LEARNING_RATE, WEIGHT_DECAY = 1e-3, 1e-2
EPOCHS, PATIENCE = 60, 6
"""The fit ends after so many passes over its steps, or after so many without a gain on the episodes for stopping."""
THRESHOLDS = np.round(np.concatenate([np.arange(0.02, 0.1, 0.01), np.arange(0.1, 0.99, 0.025)]), 3)
"""Among these `stop` is chosen."""
CALM = 1.0
"""Alarms are counted anew after so long (s) below the lower threshold."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    policy: str = option(
        "", "policy file, run folder, or name of a policy that comes with tlq", required=True
    )
    terrain: str = option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: str = option("paper", "number in [0, 1], or paper: the middle of what is recorded")
    spread: float = option(0.1, "difficulties are drawn evenly within ± this")
    episodes: int = option(300, "number of episodes to record")
    seed: int = option(9000, "of terrains, noise and fit; below 10,000, where the seeds of evaluation begin")
    horizon: float = option(0.8, "the probability is that of a fall within this time (s)")
    false_alarms: float = option(1.0, "false alarms per 10 m that the threshold may cost")
    resume: float = option(0.0, "the robot goes on after this long (s) without danger; 0: it stands for good")
    out: str = option("", "npz file to write", required=True)
    json: str = option("", "file for the figures")
    picture: str = option("", "PNG file for the reliability curve")
    recording: str = option("", "npz file in which episodes are kept; goes on with those it holds")


def fit(options: Options, report: Callable[[str], None] = print) -> dict[str, Any]:
    """Writes the monitor's file; returns the figures, as JSON."""
    check(options)
    path = find_policy(options.policy)
    dt = load_policy(path).metadata["control_dt"]
    difficulty = terrains.parse_difficulty(options.difficulty)
    setting = episodes.Setting(str(path), options.terrain, difficulty, options.spread, options.seed)
    walks = episodes.record(setting, options.episodes, options.recording, report)
    parts = split(walks, options.seed)
    ahead = round(options.horizon / dt)
    network = train(parts["fit"], parts["stopping"], ahead, options.seed, report)
    x, y = shown(network, parts["calibration"], ahead)
    scale, shift = calibration.platt(x, y)
    network = network._replace(scale=np.float32(scale), shift=np.float32(shift))
    chosen = choose(network, parts["calibration"], options, dt)
    figures = {
        "policy": options.policy,
        "policy_sha256": fingerprint(path),
        "terrain": options.terrain,
        "difficulty": [difficulty - options.spread, difficulty + options.spread],
        "episodes": {name: len(part) for name, part in parts.items()},
        "falls": {name: sum(e.fell for e in part) for name, part in parts.items()},
        "seed": options.seed,
        "horizon": options.horizon,
        "stop": chosen,
        "go": GO * chosen,
        "resume": options.resume,
        "test": measure(network, parts["test"], ahead),
        "alarms": alarms(network, parts["test"], Decision.at(chosen, CALM), options.horizon, dt),
        "curve": trade(network, parts["test"], options, dt),
        "command": command(options),
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit(),
    }
    figures = finite(figures)
    save_monitor(options.out, {k: v for k, v in figures.items() if k != "curve"}, network)
    return figures


def check(options: Options) -> None:
    """Raises ValueError on options out of range, before anything takes long."""
    terrains.parse_difficulty(options.difficulty)
    if options.episodes < len(SHARES):
        raise ValueError(f"episodes={options.episodes} must be at least {len(SHARES)}, one for each part")
    if not 0 <= options.seed < FIRST_SEED:
        raise ValueError(f"seed={options.seed} must be in [0, {FIRST_SEED - 1}]: evaluation has those above")
    for name, low, high in (
        ("spread", 0.0, 1.0),
        ("horizon", 0.1, 5.0),
        ("false_alarms", 0.0, 100.0),
        ("resume", 0.0, 60.0),
    ):
        if not low <= getattr(options, name) <= high:
            raise ValueError(f"{name}={getattr(options, name)} must be in [{low:g}, {high:g}]")
    check_folders(options, "out", "json", "picture", "recording")


def finite(value: Any) -> Any:
    """JSON with None for what is no number, such as the AUC where nobody fell."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def command(options: Options) -> str:
    """The command line that these options come from, without where it wrote to."""
    default = Options()
    given = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    left_out = ("json", "picture", "recording")
    words = [f"{k}={v}" for k, v in given.items() if v != getattr(default, k) and k not in left_out]
    return shlex.join(["python", "-m", "tlq.monitor_fit", *words])


# -- episodes to steps -----------------------------------------------------------------------------------------------


def split(walks: Sequence[Any], seed: int) -> dict[str, list[Any]]:
    """Whole episodes by part, at random: steps of one episode, nearly the same, never stand in two parts."""
    order = np.random.default_rng(seed).permutation(len(walks))
    rest = len(walks) - len(SHARES)
    bounds = [round(rest * share) for share in np.cumsum(list(SHARES.values()))]
    bounds = [bound + i + 1 for i, bound in enumerate(bounds)]
    found = zip(SHARES, np.split(order, bounds[:-1]), strict=True)
    return {name: [walks[i] for i in sorted(part)] for name, part in found}


def labels(episode: Episode, ahead: int) -> np.ndarray:
    """Whether the robot falls within `ahead` control steps, (T,): 1, 0, or NaN where that isn't known.

    It isn't where the command changes before that time is over, or the episode ends otherwise: what would have come
    of going on (or of standing on) wasn't seen.
    """
    count = len(episode.standing)
    change = np.flatnonzero(np.diff(episode.standing)) + 1  # the first steps of another command
    found = np.zeros(count)
    for first, end in zip([0, *change], [*change, count], strict=True):
        last = max(end - ahead, first)
        found[last:end] = 1.0 if end == count and episode.fell else np.nan
    return found


def shown(network: Network, part: Sequence[Episode], ahead: int) -> tuple[np.ndarray, np.ndarray]:
    """Logits (N,) of walking steps with a label, and the labels (N,)."""
    pairs = [_shown(network, e, ahead) for e in part]
    return np.concatenate([x for x, _ in pairs]), np.concatenate([y for _, y in pairs])


def _shown(network: Network, episode: Episode, ahead: int) -> tuple[np.ndarray, np.ndarray]:
    y = labels(episode, ahead)
    known = ~np.isnan(y) & ~episode.standing
    return logit(network, episode.features[known].astype(np.float32)), y[known]


# -- fit -------------------------------------------------------------------------------------------------------------


def train(
    part: Sequence[Episode], stopping: Sequence[Episode], ahead: int, seed: int, report: Callable[[str], None]
) -> Network:
    """The network with the smallest log loss on the episodes for stopping; standing steps are learnt, too."""
    import jax
    import optax

    x, y = _steps(part, ahead)
    stop_x, stop_y = _steps(stopping, ahead)
    random = np.random.default_rng(seed)
    network = initial(x, y, random)
    optimiser = optax.adamw(LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    weights = (network.kernels, network.biases)

    def loss(weights: Any, x: Any, y: Any) -> Any:
        value = logit(network._replace(kernels=weights[0], biases=weights[1]), x)
        return optax.sigmoid_binary_cross_entropy(value, y).mean()

    @jax.jit
    def update(weights: Any, state: Any, x: Any, y: Any) -> Any:
        change, state = optimiser.update(jax.grad(loss)(weights, x, y), state, weights)
        return optax.apply_updates(weights, change), state

    state, best, idle = optimiser.init(weights), (np.inf, network), 0
    for epoch in range(EPOCHS):
        order = random.permutation(len(x))
        for first in range(0, max(len(x) - BATCH, 0) + 1, BATCH):
            rows = order[first : first + BATCH]
            weights, state = update(weights, state, x[rows], y[rows])
        kernels, biases = jax.device_get(weights)
        found = network._replace(kernels=tuple(kernels), biases=tuple(biases))
        value, idle = calibration.log_loss(logit(found, stop_x), stop_y), idle + 1
        if value < best[0]:
            best, idle = (value, found), 0
        report(f"fit, pass {epoch + 1}: log loss {value:.4f} on episodes for stopping, best {best[0]:.4f}")
        if idle >= PATIENCE:
            break
    return best[1]


def initial(x: np.ndarray, y: np.ndarray, random: np.random.Generator) -> Network:
    """A network that predicts the base rate of y (N,) for features x (N, F)."""
    sizes = [x.shape[1], *HIDDEN, 1]
    kernels = [
        random.normal(size=(n, m)) * np.sqrt(1.0 / n) for n, m in zip(sizes[:-1], sizes[1:], strict=True)
    ]
    kernels[-1] *= 0.0
    rate = np.clip(y.mean(), 1e-3, 1.0 - 1e-3)
    biases = [np.zeros(m, np.float32) for m in sizes[1:]]
    biases[-1] += np.float32(np.log(rate / (1.0 - rate)))
    return Network(
        mean=x.mean(axis=0),
        std=x.std(axis=0) + np.float32(1e-3),
        kernels=tuple(np.asarray(kernel, np.float32) for kernel in kernels),
        biases=tuple(biases),
        scale=np.float32(1.0),
        shift=np.float32(0.0),
    )


def _steps(part: Sequence[Episode], ahead: int) -> tuple[np.ndarray, np.ndarray]:
    """Features (N, F) and labels (N,) of all steps that have one."""
    known = [labels(e, ahead) for e in part]
    x = np.concatenate([e.features[~np.isnan(y)] for e, y in zip(part, known, strict=True)])
    return x.astype(np.float32), np.concatenate([y[~np.isnan(y)] for y in known]).astype(np.float32)


# -- thresholds ------------------------------------------------------------------------------------------------------


def alarms(
    network: Network, part: Sequence[Episode], decision: Decision, horizon: float, dt: float
) -> dict[str, Any]:
    """What alarms would have come while the robot walked, had they been ignored.

    A fall is foreseen if an alarm came within twice the horizon before it; an alarm without a fall in that time is a
    false one. An alarm is over as `Decision` says. Of stretches that end because the robot was told to stand, alarms
    in their last two horizons aren't counted: whether there would have been a fall isn't known.

    Returns:
      Falls, how many were foreseen, by how much (s), false alarms per 10 m, and the share of the distance that is lost
      if the robot stands for good at its first alarm.
    """
    window, lead, false, walked = round(2.0 * horizon / dt), [], 0, 0.0
    falls, kept, whole_way = 0, 0.0, 0.0
    for episode in part:
        p = calibration.sigmoid(logit(network, episode.features.astype(np.float32))).tolist()
        for first, end, fell in stretches(episode):
            decision.reset()
            starts, before = [], False
            for t in range(first, end):
                now = decision.step(p[t], dt)
                if now and not before:
                    starts.append(t)
                before = now
            near = [t for t in starts if t >= end - window]
            begin = float(episode.progress[first])
            way = float(episode.progress[end - 1]) - begin
            walked, whole_way, falls = walked + way, whole_way + way, falls + fell
            kept += float(episode.progress[starts[0]]) - begin if starts else way
            false += len(starts) - len(near)
            if fell and near:
                lead.append((end - 1 - near[0]) * dt)
    return {
        "falls": int(falls),
        "foreseen": len(lead),
        "lead_s": {q: float(np.percentile(lead, v)) for q, v in (("p25", 25), ("median", 50), ("p75", 75))}
        if lead
        else None,
        "foreseen_by_0.3_s": int(np.sum(np.array(lead) >= 0.3)),
        "false_alarms_per_10_m": 10.0 * false / walked if walked > 0 else 0.0,
        "distance_lost": 1.0 - kept / whole_way if whole_way > 0 else 0.0,
    }


def stretches(episode: Episode) -> list[tuple[int, int, bool]]:
    """Where the robot is told to walk: the first step, the one after the last, and whether that one was a fall."""
    walking = np.diff(np.concatenate([[0], (~episode.standing).astype(int), [0]]))
    pairs = zip(np.flatnonzero(walking == 1), np.flatnonzero(walking == -1), strict=True)
    count = len(episode.standing)
    return [(int(a), int(b), bool(episode.fell and b == count)) for a, b in pairs]


def choose(network: Network, part: Sequence[Episode], options: Options, dt: float) -> float:
    """The lowest threshold down to which there are no more false alarms per 10 m than may be, on these episodes.

    Sought from above: far below, where there is always an alarm, there is only one.
    """
    chosen = THRESHOLDS[-1]
    for stop in THRESHOLDS[::-1]:
        found = alarms(network, part, Decision.at(stop, CALM), options.horizon, dt)
        if found["false_alarms_per_10_m"] > options.false_alarms:
            break
        chosen = stop
    return float(chosen)


def trade(network: Network, part: Sequence[Episode], options: Options, dt: float) -> list[dict[str, Any]]:
    """`alarms` at every threshold."""
    return [
        {"stop": float(s), **alarms(network, part, Decision.at(s, CALM), options.horizon, dt)}
        for s in THRESHOLDS
    ]


# -- figures ---------------------------------------------------------------------------------------------------------


def measure(network: Network, part: Sequence[Episode], ahead: int) -> dict[str, Any]:
    """How good the probabilities are on walking steps; intervals by drawing episodes anew."""
    pairs = [pair for pair in (_shown(network, e, ahead) for e in part) if len(pair[1])]
    both = [(calibration.sigmoid(x), y) for x, y in pairs]

    def over(statistic: Callable[[np.ndarray, np.ndarray], float]) -> Callable[[list[Any]], float]:
        def joined(groups: list[Any]) -> float:
            return statistic(np.concatenate([p for p, _ in groups]), np.concatenate([y for _, y in groups]))

        return joined

    def base(p: np.ndarray, y: np.ndarray) -> float:
        return float(y.mean() * (1.0 - y.mean()))

    def gain(p: np.ndarray, y: np.ndarray) -> float:
        return 1.0 - calibration.brier(p, y) / max(base(p, y), 1e-9)

    p, y = (np.concatenate(column) for column in zip(*both, strict=True))
    statistics = {
        "brier": calibration.brier,
        "brier_of_base_rate": base,
        "brier_skill": gain,
        "auc": calibration.auc,
        "expected_calibration_error": calibration.expected_error,
    }
    return {
        "episodes": len(both),
        "steps": len(y),
        "base_rate": float(y.mean()),
        **{name: calibration.bootstrap(both, over(s)) for name, s in statistics.items()},
        "reliability": calibration.reliability(p, y),
    }


def draw(figures: dict[str, Any], path: str) -> None:
    """The reliability curve, and what alarms foresee against what they cost, over the thresholds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    rows = figures["test"]["reliability"]
    left.plot([0, 1], [0, 1], "0.7", lw=1)
    left.plot([r["predicted"] for r in rows], [r["observed"] for r in rows], "C0.-")
    for r in rows:
        place = (r["predicted"], r["observed"])
        left.annotate(str(r["steps"]), place, (4, -10), textcoords="offset points", fontsize=7)
    left.set_xlabel(f"predicted probability of a fall within {figures['horizon']:g} s")
    left.set_ylabel("share of steps before a fall")
    left.set_title(f"held-out episodes: {figures['episodes']['test']} (numbers: steps)", fontsize=10)
    rows = figures["curve"]
    falls = max(rows[0]["falls"], 1)
    cost = [r["false_alarms_per_10_m"] for r in rows]
    right.plot(cost, [r["foreseen"] / falls for r in rows], "C0.-", label="foreseen")
    right.plot(cost, [r["foreseen_by_0.3_s"] / falls for r in rows], "C1.-", label="by 0.3 s or more")
    chosen = figures["alarms"]
    right.plot(chosen["false_alarms_per_10_m"], chosen["foreseen"] / falls, "ko", label="chosen threshold")
    right.set_xlabel("false alarms per 10 m")
    right.set_ylabel(f"share of {falls} falls")
    right.set_ylim(0, 1.02)
    right.legend(fontsize=8)
    with whole(path) as temporary:
        figure.savefig(temporary, dpi=90, format="png")
    plt.close(figure)


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""

    def interval(name: str) -> str:
        found = figures["test"][name]
        if None in found.values():
            return "-"
        return f"{found['value']:.3f} (95 %: {found['low']:.3f} to {found['high']:.3f})"

    found = figures["alarms"]
    lead = found["lead_s"]
    rows = [
        ("Brier score", interval("brier")),
        ("of the base rate", interval("brier_of_base_rate")),
        ("AUC", interval("auc")),
        ("calibration error", interval("expected_calibration_error")),
        ("threshold", f"{figures['stop']:.3f}"),
        ("falls foreseen", f"{found['foreseen']} of {found['falls']}"),
        ("by", f"{lead['median']:.2f} s (median)" if lead else "-"),
        ("false alarms", f"{found['false_alarms_per_10_m']:.2f} per 10 m"),
    ]
    head = f"{figures['test']['episodes']} episodes that neither fit nor calibration saw"
    return "\n".join([head, *(f"{name:<20}{value}" for name, value in rows)])


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = parse(Options, arguments, __doc__ or "")
    figures = fit(options, lambda line: print(line, flush=True))
    print(table(figures))
    if options.json:
        write_json(options.json, figures)
    if options.picture:
        draw(figures, options.picture)


if __name__ == "__main__":
    run(main)
