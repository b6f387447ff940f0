"""The guide against slow loops on true terrain and MuJoCo's feet, and where the slope of its cost leads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import interpolate

import envs
import terrains
import tg
from envs import guide
from envs.env import exact_sensors
from tests.envs.subjects import cell_centres, change_episode, standing

LEFT, RIGHT = np.array([0.0, 1.0]), np.array([0.0, -1.0])


def walking(subject, k, xy, command, phase=np.pi / 2, mirror=1.0):
    """A robot in a step on terrain k, its feet led a little aside."""
    qpos = standing(subject.env, xy=xy, yaw=0.4)
    episode = subject.begin(jax.random.key(3), jnp.int32(9))
    controller = episode.controller
    random = np.random.default_rng(round(1000 * abs(phase)))
    controller = controller._replace(
        phase=jnp.float32(phase),
        gate=jnp.float32(1.0),
        stride=jnp.asarray(tg.frames.turn(np.array(-0.4), command), jnp.float32),
        mirror=jnp.float32(mirror),
        targets=controller.targets + jnp.asarray(random.normal(scale=0.03, size=(2, 12)), jnp.float32),
    )
    episode = episode.replace(controller=controller)
    return change_episode(episode, qpos=qpos, terrain=k, command=command, floor=-0.5)


def ground(terrain, env, xy, way):
    """Height (m) of the terrain at a place (2,) m from a robot at xy, its heading 0.4 rad."""
    at = np.asarray(xy) + tg.frames.turn(np.array(0.4), way)
    return float(terrains.exact_height(terrain, cell_centres(env.bank, at)))


def gap_shares(height, rewards):
    """How much gap a foot meets at each of the guide's places, if it lands near it."""
    n, near = guide.REACH + guide.NEAR, range(-guide.NEAR, guide.NEAR + 1)
    cells = [(i, j) for i in range(-n, n + 1) for j in range(-n, n + 1)]
    heights = {cell: height(guide.CELL * np.array(cell)) for cell in cells}
    top = max(heights.values())
    weight = {
        (a, b): np.exp(-0.5 * (a * a + b * b) * (guide.CELL / guide.ERROR) ** 2) for a in near for b in near
    }
    shares = []
    for i, j in np.round(guide.places() / guide.CELL).astype(int):
        low = [w for (a, b), w in weight.items() if top - heights[i + a, j + b] > rewards.gap_threshold]
        shares.append(sum(low) / sum(weight.values()))
    return np.array(shares)


def lacking(gaps):
    """How far (m) each of the guide's places is from the nearest that has less gap than ground."""
    rim = guide.CELL * (guide.REACH + 1)
    firm = guide.places()[gaps < 0.5]
    return np.array([min([rim, *np.linalg.norm(firm - place, axis=1)]) for place in guide.places()])


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.5, 1.0])
def test_what_a_place_lacks_to_ground(share):
    gaps = np.random.default_rng(0).random((3, guide.SIDE, guide.SIDE)) < 1 - share
    found = jax.jit(guide.lacking)(gaps.astype(np.float32))
    for table, distances in zip(gaps, found, strict=True):
        np.testing.assert_allclose(np.ravel(distances), lacking(np.ravel(table)), atol=1e-6)


@pytest.mark.parametrize("command", [LEFT, RIGHT])
def test_feet_are_led_to_the_best_ground_near(exact, command):
    env, k, random = exact.env, exact.find("poles", 9), np.random.default_rng(0)
    terrain, c = exact.terrain(k), env.config
    displacements = jax.jit(lambda episode: guide.displacements(env, episode))
    led = 0
    for xy in random.uniform(-1.2, 1.2, (20, 2)):
        episode = walking(exact, k, xy, command, phase=random.uniform(0.0, np.pi))
        found, asked = map(np.asarray, displacements(episode))
        phases = tg.path.leg_phases(np.asarray(episode.controller.phase))
        assert not asked[phases <= guide.LIFTING].any()
        speed = 2 * episode.controller.frequency * c.tg.step_length
        excess = env.velocity(episode) - speed * episode.controller.stride
        balance = np.clip(guide.BALANCE * np.asarray(excess), -guide.AWAY, guide.AWAY)
        residual = env.core.residual_displacement(episode.controller, envs.env.exact_sensors(episode))
        legs = np.flatnonzero(phases > 0)
        ends = np.asarray(env.step_ends(episode))[legs]
        across = np.array([-1, 1]) * (ends[0] - ends[1])[::-1] / np.linalg.norm(ends[0] - ends[1])
        costs, shares = [], []
        for leg, end in zip(legs, ends, strict=True):
            share = np.clip((phases[leg] - guide.LIFTING) / (guide.ARRIVED - guide.LIFTING), 0.0, 1.0)
            shares.append(3 * share**2 - 2 * share**3)
            reach = guide.REACH * guide.CELL
            now = np.clip(np.asarray(residual)[leg, :2] / max(shares[-1], 0.3), -reach, reach)
            gaps = gap_shares(lambda way, end=end, xy=xy: ground(terrain, env, xy, end + way), c.rewards)
            gaps += guide.LACKING * lacking(gaps)
            away = np.linalg.norm(now - guide.places(), axis=1)
            far = np.linalg.norm(balance - guide.places(), axis=1)
            costs.append(gaps + (far / guide.FAR) ** 2 + guide.FARTHER * far + guide.ANOTHER * away)
            axis = np.arange(-guide.REACH, guide.REACH + 1) * guide.CELL
            table = gaps.reshape(guide.SIDE, guide.SIDE)
            here = interpolate.RegularGridInterpolator((axis, axis), table)(now)[0]
            danger = max(gaps[len(gaps) // 2], here)
            if abs(danger - guide.SAFE) > 1e-4:
                assert asked[leg] == (danger > guide.SAFE and phases[leg] > guide.LIFTING)
        if shares[0] < 0.01:
            continue
        chosen = [
            int(np.argmin(np.linalg.norm(share * guide.places() - found[leg], axis=1)))
            for leg, share in zip(legs, shares, strict=True)
        ]
        np.testing.assert_allclose(np.array(shares)[:, None] * guide.places()[chosen], found[legs], atol=1e-5)

        def together(first, second, costs=costs, across=across, balance=balance):
            middle = (guide.places()[first] + guide.places()[second]) / 2 - balance
            return costs[0][first] + costs[1][second] + guide.ACROSS * abs(middle @ across)

        best = [np.argsort(cost)[: guide.CANDIDATES] for cost in costs]
        least = min(together(i, j) for i in best[0] for j in best[1])
        assert together(*chosen) <= least + 1e-3
        led += asked.sum()
    assert led > 5


def feet_by_mujoco(exact, episode, action):
    """Feet (L, 2) m, heading frame, of the trajectory generator's next targets and residual actions of the robot's."""
    env, core, controller = exact.env, exact.env.core, episode.controller
    phase = tg.path.advance(np.asarray(controller.phase), np.float32(controller.frequency), 0.02)
    target = core.foot_targets(
        tg.path.leg_phases(phase),
        np.asarray(controller.lift),
        np.asarray(controller.stride),
        exact_sensors(episode),
    )
    qpos = np.array(episode.qpos)
    angles = np.asarray(tg.leg.inverse(core.geometry, target)).ravel()
    qpos[7:] = angles + core.config.residual_range * np.asarray(action)[2:]
    feet = exact.kinematics(qpos).site_xpos[env.robot.foot_site_ids, :2]
    return tg.frames.turn(-tg.frames.yaw(np.asarray(episode.qpos[3:7])), feet)


@pytest.mark.parametrize("command", [LEFT, RIGHT])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_guidance_is_about_the_policys_own_actions(exact, command, mirror):
    """Legs, sides and what residual actions do are those of the mirror image if the policy sees that."""
    env, k, random = exact.env, exact.find("poles", 9), np.random.default_rng(1)
    core = env.core
    both = jax.jit(lambda episode, held: (guide.guide(env, episode, held), guide.steps(env, episode)))
    asked = 0
    for xy in random.uniform(-1.2, 1.2, (6, 2)):
        episode = walking(exact, k, xy, command, phase=random.uniform(0.0, np.pi), mirror=mirror)
        last = random.uniform(-0.5, 0.5, 14).astype(np.float32)
        controller = episode.controller
        episode = episode.replace(
            controller=controller._replace(actions=controller.actions.at[0].set(jnp.asarray(last)))
        )
        held = random.uniform(-0.03, 0.03, (4, 2)).astype(np.float32)
        guidance, steps = jax.tree.map(np.asarray, both(episode, held))
        mirrored = core.update_mirror(episode.controller.mirror, env.heading_command(episode))
        side = np.array([1.0, mirrored])
        order = np.array([0, 1, 2, 3] if mirrored > 0 else [1, 0, 3, 2])
        np.testing.assert_array_equal(guidance.legs, order[steps.legs])
        np.testing.assert_allclose(guidance.ahead, steps.ahead * side)
        np.testing.assert_allclose(guidance.across @ (side * (steps.ends[0] - steps.ends[1])), 0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(guidance.across), 1, rtol=1e-5)
        np.testing.assert_allclose(guidance.weight, np.where(steps.asked, steps.share, 0))
        np.testing.assert_allclose(guidance.gaps[:, :, :: round(float(mirrored))], steps.gaps, atol=1e-3)
        still = feet_by_mujoco(exact, episode, np.zeros(14))
        for action, off in ((last, 1e-4), (last + random.uniform(-0.1, 0.1, 14), 2e-3)):
            moved = (feet_by_mujoco(exact, episode, action) - still)[order] * side
            own = np.asarray(core.mirror_action(mirrored, action))[2:].reshape(4, 3)
            said = np.einsum("lij,lj->li", guidance.lead[..., :3], own) + guidance.lead[..., 3]
            np.testing.assert_allclose(said, moved, atol=off)
            if action is last:
                np.testing.assert_allclose(guidance.last, moved[guidance.legs], atol=off)
        np.testing.assert_allclose(guidance.held, held[order] * side)
        phases = np.asarray(tg.path.leg_phases(episode.controller.phase))[order]
        weight = np.clip(np.linalg.norm(guidance.held, axis=1) / guide.LED, 0, 1)
        np.testing.assert_allclose(guidance.hold, np.where(phases > 0, 0, weight), rtol=1e-5)
        asked += steps.asked.sum()
    assert asked > 2


def test_residuals_lead_feet_where_they_should(exact):
    env, k, random = exact.env, exact.find("poles", 9), np.random.default_rng(2)
    residuals = jax.jit(lambda episode, led: guide.residuals(env, episode, led))
    for xy in random.uniform(-1.2, 1.2, (3, 2)):
        episode = walking(exact, k, xy, LEFT, phase=random.uniform(0.0, np.pi))
        led = random.uniform(-0.05, 0.05, (4, 2))
        action = np.concatenate([np.zeros(2), np.asarray(residuals(episode, jnp.asarray(led))).ravel()])
        moved = feet_by_mujoco(exact, episode, action) - feet_by_mujoco(exact, episode, np.zeros(14))
        np.testing.assert_allclose(moved, led, atol=1e-4)


def slow_cost(guidance, action):
    """`guide.cost` of one action, with scipy's interpolation and a loop."""
    axis = np.arange(-guide.REACH, guide.REACH + 1) * guide.CELL
    total, middle = 0.0, np.zeros(2)
    feet = [lead[:, :3] @ action[2 + 3 * i : 5 + 3 * i] + lead[:, 3] for i, lead in enumerate(guidance.lead)]
    for foot, held, hold in zip(feet, guidance.held, guidance.hold, strict=True):
        total += guide.HOLD * hold * sum((foot - held) ** 2) / guide.HELD**2
    weights = guidance.weight * guidance.known
    swinging = zip(guidance.gaps, guidance.legs, weights, guidance.last, guidance.error, strict=True)
    for gaps, leg, weight, last, error in swinging:
        led = feet[leg]
        inside = np.clip(led, axis[0], axis[-1])
        landed = np.clip(led + error, axis[0], axis[-1])
        gap = interpolate.RegularGridInterpolator((axis, axis), gaps.astype(float))(landed)[0]
        away = np.linalg.norm(led - guidance.ahead)
        total += weight * (guide.GAP * gap + (away / guide.FAR) ** 2)
        total += weight * (guide.FARTHER * away + guide.BEYOND * np.abs(led - inside).sum())
        total += weight * sum((led - last) ** 2) / guide.STEADY**2
        middle += (led - guidance.ahead) / 2
    return total + weights.min() * guide.ACROSS * abs(middle @ guidance.across)


def test_legs_that_nothing_is_asked_of_cost_by_what_they_are_moved():
    random = np.random.default_rng(0)
    for _ in range(20):
        weight, hold = random.uniform(0, 1, 2), random.uniform(0, 1, 4) * (random.uniform(size=4) < 0.5)
        legs = random.permutation(4)[:2]
        residual = random.normal(size=12)
        expected = 0.0
        for leg in range(4):
            asked = max([hold[leg], *(w for w, which in zip(weight, legs, strict=True) if which == leg)])
            moved = sum(residual[3 * leg + joint] ** 2 for joint in range(3))
            expected += (guide.ALWAYS + guide.IDLE * (1 - asked)) * moved
        nothing = dict.fromkeys(guide.Guidance._fields)
        guidance = guide.Guidance(
            **nothing | {"legs": jnp.asarray(legs), "weight": jnp.asarray(weight), "hold": jnp.asarray(hold)}
        )
        found = guide.idle(guidance, jnp.asarray(residual, jnp.float32))
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_cost_against_a_loop():
    random = np.random.default_rng(3)
    for _ in range(50):
        across = random.normal(size=2)
        guidance = guide.Guidance(
            lead=random.normal(scale=0.08, size=(4, 2, 4)).astype(np.float32),
            legs=random.permutation(4)[:2].astype(np.int32),
            gaps=random.uniform(size=(2, guide.SIDE, guide.SIDE)).astype(np.float16),
            ahead=random.uniform(-0.1, 0.1, 2).astype(np.float32),
            across=(across / np.linalg.norm(across)).astype(np.float32),
            weight=random.uniform(0, 1, 2).astype(np.float32),
            held=random.normal(scale=0.05, size=(4, 2)).astype(np.float32),
            hold=random.uniform(0, 1, 4).astype(np.float32),
            last=random.normal(scale=0.05, size=(2, 2)).astype(np.float32),
            error=random.normal(scale=0.02, size=(2, 2)).astype(np.float32),
            known=(random.uniform(size=2) < 0.8).astype(np.float32),
            mirror=np.float32(1.0),
        )
        action = random.uniform(-1, 1, 14).astype(np.float32)
        found = guide.cost(jax.tree.map(jnp.asarray, guidance), jnp.asarray(action))
        np.testing.assert_allclose(found, slow_cost(guidance, action), rtol=1e-4, atol=0.005)


def test_errors_are_those_of_the_next_landing():
    random = np.random.default_rng(5)
    steps, robots = 30, 3
    missed = random.normal(size=(steps, robots, 4, 2)).astype(np.float32)
    landed = random.uniform(size=(steps, robots, 4)) < 0.1
    done = (random.uniform(size=(steps, robots)) < 0.05).astype(np.float32)
    error, known = (
        np.asarray(x) for x in guide.next_errors(*(jnp.asarray(x) for x in (missed, landed, done)))
    )
    for t, robot, leg in np.ndindex(steps, robots, 4):
        later = t
        while later < steps and not landed[later, robot, leg] and not done[later, robot]:
            later += 1
        found = later < steps and landed[later, robot, leg]
        assert known[t, robot, leg] == found
        if found:
            np.testing.assert_array_equal(error[t, robot, leg], missed[later, robot, leg])


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_hindsight_knows_the_policys_own_sides(exact, mirror):
    env, k = exact.env, exact.find("poles", 9)
    episode = walking(exact, k, np.zeros(2), LEFT if mirror > 0 else RIGHT, phase=2.0, mirror=mirror)
    guidance, steps = guide.guide(env, episode, jnp.zeros((4, 2))), guide.steps(env, episode)
    assert guidance.mirror == mirror and np.all(guidance.known == 1) and np.all(guidance.error == 0)
    error = np.arange(8.0).reshape(4, 2) + 1
    known = np.array([True, False, False, True])
    with_errors = guide.with_errors(guidance, jnp.asarray(error), jnp.asarray(known))
    np.testing.assert_array_equal(with_errors.error, error[steps.legs] * [1, mirror])
    np.testing.assert_array_equal(with_errors.known, known[steps.legs])
    np.testing.assert_array_equal(with_errors.weight, guidance.weight)


def test_its_slope_leads_feet_off_the_gaps(exact, monkeypatch):
    """Going down the slope of the cost from no residuals at all, feet end where there is less gap."""
    monkeypatch.setattr(guide, "STEADY", np.inf)  # as after many steps
    env, k, random = exact.env, exact.find("poles", 9), np.random.default_rng(4)

    @jax.jit
    def descended(episode):
        guidance = guide.guide(env, episode, jnp.zeros((4, 2)))

        def gap(action):
            own = action[2:].reshape(4, 3)
            led = (jnp.einsum("lij,lj->li", guidance.lead[..., :3], own) + guidance.lead[..., 3])[
                guidance.legs
            ]
            return guide.between(guidance.gaps.astype(jnp.float32), led) * (guidance.weight > 0.9)

        slope = jax.grad(lambda action: guide.cost(guidance, action))
        action = jax.lax.fori_loop(0, 200, lambda _, a: a - 0.01 * slope(a), jnp.zeros(14))
        return gap(jnp.zeros(14)), gap(action)

    pairs = []
    for xy in random.uniform(-1.2, 1.2, (20, 2)):
        episode = walking(exact, k, xy, LEFT, phase=random.uniform(1.6, np.pi))
        pairs.append(np.asarray(descended(episode)))
    before, after = np.mean(pairs, axis=(0, 2))
    assert before > 0.1
    assert after < 0.4 * before


def test_only_terrain_with_gaps_has_pits(exact):
    assert exact.env.has_pits
    flat = terrains.TerrainConfig(kind="flat", num_terrains=12, half_extent=2.0)
    assert not envs.make(envs.EnvConfig(terrain=flat)).has_pits


@pytest.mark.slow
def test_a_guided_environment_can_be_asked(exact):
    env = envs.Guided(exact.auto)
    state = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(env.step)(state, 0.5 * jnp.ones(14))
    controller = after.pipeline_state.controller
    now = exact.env.core.residual_displacement(controller, exact_sensors(after.pipeline_state))[:, :2]
    swing = np.asarray(tg.path.leg_phases(controller.phase))[:, None] > 0
    before = np.asarray(state.info["held"])
    held = np.where(swing, before + guide.SMOOTHING * (np.asarray(now) - before), before)
    np.testing.assert_allclose(after.info["held"], held, atol=1e-5)
    alone = jax.jit(lambda episode: guide.guide(exact.env, episode, after.info["held"]))
    for added, own in zip(jax.jit(env.guidance)(after), alone(after.pipeline_state), strict=True):
        np.testing.assert_allclose(added, own, atol=1e-6)
    standing_still = alone(change_episode(after.pipeline_state, command=np.zeros(2)))
    np.testing.assert_array_equal(standing_still.weight, 0)
    np.testing.assert_array_equal(standing_still.hold, 0)


@pytest.mark.slow
def test_landings_are_where_feet_come_down(exact):
    """Against the robot's states, one foot after the other."""
    env, core = envs.Guided(exact.auto), exact.env.core
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(1))

    def places(episode):
        """In the world: where the feet are led (4, 2) m, and where they are; and which are in swing."""
        yaw, sensors = tg.frames.yaw(episode.qpos[3:7]), exact_sensors(episode)
        led = exact.env.step_ends(episode) + core.residual_displacement(episode.controller, sensors)[:, :2]
        feet, swing = core.feet(sensors)[:, :2], tg.path.leg_phases(episode.controller.phase) > 0
        return [episode.qpos[:2] + tg.frames.turn(yaw, p) for p in (led, feet)], swing, yaw

    places = jax.jit(places)
    last, since, landings = [None] * 4, [None] * 4, 0
    for number in range(160):
        action = 0.2 * jnp.sin(0.3 * number + jnp.arange(14))
        state = step(state, action)
        (led, feet), swing, yaw = jax.tree.map(np.asarray, places(state.pipeline_state))
        found = state.info["landings"]
        for leg in range(4):
            landed = False
            if state.done:
                last[leg] = since[leg] = None
            elif swing[leg]:
                last[leg], since[leg] = led[leg], 0
            elif since[leg] is not None:
                since[leg] += 1
                landed = since[leg] == guide.SETTLED
            assert found.landed[leg] == landed
            if landed:
                landings += 1
                missed = tg.frames.turn(-yaw, feet[leg] - last[leg])
                np.testing.assert_allclose(found.missed[leg], missed, atol=1e-5)
    assert landings > 12
