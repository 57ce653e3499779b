"""Figures of scores against computations of their own: control while learning, rounds, curves of regret, the bound."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from harness.errors import FitError, InputError
from harness.protocols import Growth, Hindsight
from harness.scoring.bound import LinearTruth, _root_covariance, _white, _without, least_errors, linear_truth
from harness.scoring.control import LinearPlantModel, control_regret, control_score, linearise
from harness.scoring.predictive import ProbabilityScore, reliability
from harness.scoring.regret import Regret, regret
from harness.scoring.rounds import interleaved
from harness.signals import Channel, FloatArray, PlantSpec, Trajectory
from identifiers.finite.mdp import MdpModel
from plants.equations.linear import LinearPlant
from plants.equations.ode import pendulum_ode

A, B = np.array([[1.01, 0.1], [0.0, 0.98]]), np.array([[0.0], [0.4]])
EYE = np.eye(2)


def lqr(
    a: FloatArray, b: FloatArray, q: FloatArray = EYE, r: FloatArray = EYE[:1, :1]
) -> tuple[FloatArray, FloatArray]:
    """Return the gain and what a unit disturbance of each state costs (Anderson & Moore 1990, ch. 2)."""
    p = linalg.solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a), p


class Scripted:
    """Gives one model after the other, None for a refusal, and keeps what it was shown."""

    def __init__(self, *models: tuple[FloatArray, FloatArray] | None) -> None:
        self.models, self.shown = list(models), list[Any]()

    def fit(self, records: Any, *, rng: np.random.Generator) -> Any:
        self.shown.append([(record.u.copy(), record.y.copy()) for record in records])
        found = self.models.pop(0)
        if found is None:
            raise FitError("data", expected="more", got="less", remedy="record longer")
        return SimpleNamespace(a_matrix=found[0], b_matrix=found[1], c_matrix=EYE)


def test_control_while_learning_costs_what_its_own_simulation_costs() -> None:
    """Designs at 20, 40, 80, ...; the first controller is back where a design lets a step cost ten times as much."""
    first, q, r = np.array([[0.5, 1.0]]), np.diag([1.0, 3.0]), np.array([[0.2]])
    for bad in ((A, -B), None):
        identifier: Any = Scripted((A, 1.3 * B), bad, (A, B))
        found = control_regret(
            identifier, (A, B), steps=120, rng=np.random.default_rng(5), noise=0.2, first_gain=first, first=20,
            excitation=0.5, q=q, r=r,
        )  # fmt: skip
        rng = np.random.default_rng(5)
        pushes, gain, x, costs, inputs, states, fell = (
            0.2 * rng.normal(size=(120, 2)),
            first,
            np.zeros(2),
            [],
            [],
            [],
            0,
        )
        for k in range(120):
            at = {20: (A, 1.3 * B), 40: bad, 80: (A, B)}.get(k)
            if at is not None:
                gain = lqr(*at, q, r)[0]
            if k > 20 and costs[-1] > 10 * max(costs[:20]):
                gain, fell = first, fell + 1
            u = -gain @ x + 0.5 / (k + 1) ** 0.25 * rng.normal(size=1)
            costs.append(float(x @ q @ x + u @ r @ u))
            states.append(x)
            inputs.append(u)
            x = A @ x + B @ u + pushes[k]
        best, p = lqr(A, B, q, r)
        x, ideal = np.zeros(2), []
        for push in pushes:
            ideal.append(float(x @ q @ x + (best @ x) @ r @ (best @ x)))
            x = (A - B @ best) @ x + push
        assert (fell > 0) == (bad is not None)
        assert found.costs == pytest.approx(costs)
        assert found.best_costs == pytest.approx(ideal)
        assert found.optimal == pytest.approx(0.2**2 * np.trace(p))
        assert found.designs == ((20, 40, 80) if bad else (20, 80))
        assert found.total == pytest.approx(sum(costs) - sum(ideal))
        for ((u, y),), n in zip(identifier.shown, (20, 40, 80), strict=True):
            assert u == pytest.approx(np.array(inputs[:n]))
            assert y == pytest.approx(np.array(states[:n]))


def test_rounds_carry_gain_and_cost_over_what_is_refused_or_does_not_hold() -> None:
    wrong, spec = (A, 0.5 * B), PlantSpec((Channel("u"),), (Channel("p"), Channel("v")), 1.0)
    identifier: Any = Scripted(None, wrong, (A, -B), None, (A, B))
    gains, data = [], []

    def collect(gain: FloatArray, number: int) -> Trajectory:
        rng = np.random.default_rng(number)
        gains.append(gain)
        data.append(Trajectory(np.arange(9.0), rng.normal(size=(9, 1)), rng.normal(size=(9, 2)), spec))
        return data[-1]

    first = np.array([[1.0, 2.0]])
    found = interleaved(identifier, collect, (A, B), first, rng=np.random.default_rng(0))
    held = lqr(*wrong)[0]
    for gain, wanted in zip(gains, (first, first, held, held, held), strict=True):
        assert gain == pytest.approx(wanted)
    loop = A - B @ held
    cost = linalg.solve_discrete_lyapunov(loop.T, EYE + held.T @ held)
    ratio = float(np.trace(cost) / np.trace(lqr(A, B)[1]))
    assert [one.cost.status for one in found] == ["no design", "ok", "unstable", "unstable", "ok"]
    assert [one.cost.ratio for one in found] == pytest.approx([np.nan, ratio, np.inf, np.inf, 1.0], nan_ok=True)
    assert [bool(one.refused) for one in found] == [True, False, False, True, False]
    assert [len(shown) for shown in identifier.shown] == [1, 2, 3, 4, 5]
    for number, one in enumerate(found, start=1):
        so_far = np.concatenate([np.hstack([each.y, each.u]) for each in data[:number]])
        alike = so_far / np.sqrt(np.mean(so_far**2, axis=0))
        assert one.coverage == pytest.approx(np.sqrt(np.linalg.eigvalsh(alike.T @ alike / len(alike))[0]))


def test_coverage_leaves_out_a_channel_that_stands_still() -> None:
    spec = PlantSpec((Channel("u"),), (Channel("x"),), 1.0)
    still = Trajectory(np.arange(4.0), np.zeros((4, 1)), np.array([[1.0], [-1.0], [2.0], [3.0]]), spec)
    refuses: Any = Scripted(None)
    (one,) = interleaved(
        refuses, lambda gain, number: still, (A[:1, :1], EYE[:1, :1]), np.zeros((1, 1)), rounds=1,
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert one.coverage == 0.0


STEPS = np.array([2.0, 4.0, 8.0, 9.0, 16.0, 32.0, 64.0])


def curved(law: Any, factor: float | None, curve: FloatArray, burn_in: int = 4) -> Regret:
    loss = np.concatenate([np.full(burn_in, 99.0), np.full(60, 0.5)])
    return Regret(
        loss + 1.0, loss, exact=True, steps=STEPS, curve=curve, details={"burn_in": burn_in}, growth=Growth(law, factor)
    )


@pytest.mark.parametrize(("law", "of"), [("log", np.log), ("root", np.sqrt), ("linear", np.positive)])
def test_theory_has_its_own_rise_and_the_level_of_the_curve_behind_two_burn_ins(law: str, of: Any) -> None:
    late = STEPS > 8  # at exactly two burn-ins it is not yet settled
    curve = np.where(late, 5.0 + 1.2 * of(STEPS), 1e3)
    told = curved(law, 3.0, curve)
    assert told.over_theory == pytest.approx(1.2 / (3.0 * 0.5))
    assert np.mean(told.theory[late]) == pytest.approx(np.mean(curve[late]))
    assert np.diff(told.theory) == pytest.approx(1.5 * np.diff(of(STEPS)))
    fitted = curved(law, None, curve)
    assert fitted.over_theory is None
    assert fitted.theory == pytest.approx(5.0 + 1.2 * of(STEPS))
    curve[-2:] = np.nan  # two points are no shape
    assert np.isnan(curved(law, 3.0, curve).theory).all()
    assert curved(law, 3.0, curve).over_theory is None


def test_a_bounded_regret_is_level_and_its_rise_is_that_level() -> None:
    curve = np.array([9.0, 9.0, 9.0, 1.0, 2.0, 3.0, 2.0])
    assert curved("bounded", None, curve).theory == pytest.approx(np.full(7, 2.0))
    assert curved("bounded", 2.0, curve).over_theory == pytest.approx(2.0 / (2.0 * 0.5))
    assert np.isnan(Regret(np.ones(8), np.ones(8), exact=True, steps=STEPS, curve=curve).theory).all()
    assert curved("bounded", 0.0, curve).over_theory is None


def test_each_output_s_loss_is_in_units_of_its_own_variance_in_hindsight_too() -> None:
    spec = PlantSpec((), (Channel("a"), Channel("b"), Channel("still")), 1.0)
    y = np.random.default_rng(0).normal(size=(30, 3)) * [2.0, 50.0, 0.0] + [0.0, 7.0, 3.0]
    shown = Trajectory(np.arange(30.0), np.zeros((30, 0)), y, spec)

    class Holds:
        def init(self, spec: PlantSpec, *, rng: np.random.Generator) -> FloatArray:
            return np.zeros(3)

        def start(self, state: FloatArray, y: FloatArray) -> FloatArray:
            return y

        def predict(self, state: FloatArray, u: FloatArray) -> FloatArray:
            return state

        def update(self, state: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
            return y

        def hindsight(self, trajectories: Any) -> Hindsight:
            each = np.concatenate([(one.y[1:] - one.y[0]) ** 2 for one in trajectories])
            return Hindsight(each.sum(axis=1), True, per_output=each)

    found = regret(Holds(), [shown], rng=np.random.default_rng(0), points=4)
    std = np.array([y[:, 0].std(), y[:, 1].std(), 1.0])
    assert found.scale == pytest.approx(std)
    own, best = (np.diff(y, axis=0) / std) ** 2, ((y[1:] - y[0]) / std) ** 2
    assert found.losses == pytest.approx(own.sum(axis=1))
    assert found.hindsight == pytest.approx(best.sum(axis=1))
    assert found.steps.tolist() == [1.0, 3.0, 9.0, 29.0]
    assert found.curve == pytest.approx([(own[:n] - best[:n]).sum() for n in (1, 3, 9, 29)])


def driven(plant: LinearPlant, hidden: FloatArray, sensor: float, seed: int = 0) -> Trajectory:
    """Return a record of white input and an unseen one, by the plant's equations."""
    rng = np.random.default_rng(seed)
    n = len(hidden)
    u, x = rng.standard_normal((n, 1)), np.zeros((n, len(plant.A)))
    for k in range(n - 1):
        x[k + 1] = plant.A @ x[k] + plant.B @ (u[k] + hidden[k])
    y = x @ plant.C.T + (u + hidden) @ plant.D.T + sensor * rng.standard_normal((n, len(plant.C)))
    return Trajectory(np.arange(n) * plant.spec.sample_time, u, y, plant.spec, x)


MATRICES: dict[str, Any] = {"A": [[0.7, 0.4], [-0.4, 0.7]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "sample_time": 0.1}


def test_the_noise_of_the_truth_is_what_was_added() -> None:
    rng = np.random.default_rng(7)
    with LinearPlant(**MATRICES) as plant:
        white = 0.3 * rng.standard_normal((3000, 1))
        truth = linear_truth(plant, [driven(plant, white, 0.2)], [white])
        assert truth is not None
        assert truth.r == pytest.approx(np.array([[0.04]]), rel=0.1)
        assert truth.q == pytest.approx(plant.B @ plant.B.T * np.mean(white**2), rel=1e-6, abs=1e-12)
        own = [np.zeros((1500, 1)), 0.5 * rng.standard_normal((1500, 1))]
        both = linear_truth(plant, [driven(plant, one, 0.2, seed) for seed, one in enumerate(own)], own)
        assert both is not None
        assert both.q[1, 1] == pytest.approx(0.125, rel=0.1)  # of all records together
        coloured = np.zeros((3000, 1))
        for k in range(2999):
            coloured[k + 1] = 0.8 * coloured[k] + 0.3 * white[k + 1]
        found = linear_truth(plant, [driven(plant, coloured, 0.2)], [coloured])
        assert found is not None
        pole = found.a[2, 2]
        assert pole == pytest.approx(0.8, abs=0.03)
        assert found.a[:2, 2:] == pytest.approx(plant.B)
        assert found.q[2, 2] == pytest.approx(np.mean((coloured[1:] - 0.8 * coloured[:-1]) ** 2), rel=0.1)
        assert found.start[2, 2] == pytest.approx(np.mean(coloured**2))
        assert (found.own, found.q[:2].any(), found.start[:2].any()) == (2, False, False)
        assert not found.c[:, 2:].any()
        assert not found.b[2:].any()
        walk = np.cumsum(white, axis=0)[:300] + 0.3 * np.sin(np.arange(300.0))[:, None] * 9
        assert linear_truth(plant, [driven(plant, walk, 0.2)], [walk]) is None  # neither white nor of first order


def test_noise_is_white_up_to_five_deviations_at_each_of_eight_lags_and_in_its_mean() -> None:
    n, verdicts = 1000, []
    base = np.random.default_rng(0).standard_normal(n + 9)
    for lag in (0, 1, 4, 8):
        for share in np.linspace(0.0, 0.3, 61):
            noise = base[9:] + share * (base[9 - lag : n + 9 - lag] if lag else 1.0)
            signs = [np.correlate(noise[k:], noise[: n - k])[0] / np.correlate(noise, noise)[0] for k in range(1, 9)]
            largest = np.sqrt(n) * max(np.abs([*signs, noise.mean() / np.sqrt(np.mean(noise**2))]))
            verdicts.append(largest < 5.0)
            assert _white(noise[:, None]) == verdicts[-1]
    assert 40 < sum(verdicts) < 200
    assert _white(base[9:, None] + 0.5 * base[:-9, None])  # a ninth lag is not asked for
    assert _white(np.zeros((9, 2)))
    assert not _white(np.zeros((8, 2)))
    assert not _white(np.column_stack([np.zeros(n), np.cumsum(base[9:])]))


@pytest.mark.parametrize("place", ["state", "output"])
def test_what_is_left_of_a_plant_counts_from_a_millionth_of_its_scatter_on(place: str) -> None:
    with LinearPlant(**MATRICES) as plant:
        made = driven(plant, np.zeros((400, 1)), 0.0)
        assert made.x is not None
        for share, linear in ((0.7e-6, True), (1.5e-6, False)):
            x, y = made.x.copy(), made.y.copy()
            if place == "state":  # pushed to one side at each sample: no white noise
                for k in range(399):
                    x[k + 1] = plant.A @ x[k] + plant.B @ made.u[k] + share * made.x.std(axis=0)
                y = x @ plant.C.T
            else:
                y += share * y.std(axis=0)
            truth = linear_truth(plant, [Trajectory(made.t, made.u, y, made.spec, x)], [None])
            assert (truth is not None) == linear
            assert truth is None or not (truth.q.any() or truth.r.any())


def test_a_direction_that_is_seen_a_billion_times_less_is_not_seen() -> None:
    one, other = np.eye(9)[:2]
    truth = LinearTruth(*(np.zeros((0, 0)) for _ in range(6)), own=0, start=np.zeros((0, 0)))
    for share, kept in ((0.7e-9, 1), (1.5e-9, 2)):
        assert _root_covariance(truth, np.column_stack([one, one + 2 * share * other])).shape == (2, kept)
        start = np.column_stack([one, share * other])
        left = _without(start, np.column_stack([one, other]))
        assert np.abs(left).max(axis=0).round(9).tolist() == [0.0, 2.0 - kept]


def test_what_answers_at_once_is_part_of_the_truth_s_free_run() -> None:
    with LinearPlant(**{**MATRICES, "C": [[1.0, 0.0], [0.5, 2.0]]}, D=[[3.0], [0.0]]) as plant:
        data = driven(plant, np.zeros((200, 1)), 0.1)
        truth = LinearTruth(plant.A, plant.B, plant.C, plant.D, 0 * EYE, 0.01 * EYE, 2, 0 * EYE)
        found = least_errors(truth, [data[:100]], [data[100:]])
        assert found is not None
        judged = data[100:]
        noise = (judged.y - judged.x @ plant.C.T - judged.u @ plant.D.T) / judged.y.std(axis=0)
        response = np.concatenate([plant.C @ np.linalg.matrix_power(plant.A, k) for k in range(100)])
        response /= np.tile(judged.y.std(axis=0), 100)[:, None]
        left = noise.ravel() - response @ np.linalg.lstsq(response, noise.ravel())[0]  # the start that fits best
        assert found.known_simulation == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-6)
        # parameters: nx (nu + ny) + nu ny of feedthrough, each one sample of noise, learned elsewhere: about as much
        excess = (found.simulation**2 - found.known_simulation**2) * judged.y.size
        each = 0.01 * np.mean(judged.y.std(axis=0) ** -2.0)
        assert 0.5 < excess / (each * (2 * 3 + 2)) < 2.0


def test_a_reliability_diagram_counts_every_category_in_bins_of_equal_width() -> None:
    spec = PlantSpec((), (Channel("s", kind="category", minimum=0, maximum=2),), 1.0)
    table = np.array([[[0.85, 0.1, 0.05]], [[0.0, 1.0, 0.0]], [[0.95, 0.05, 0.0]]])
    y = np.random.default_rng(0).integers(0, 3, size=60).astype(float)
    data = Trajectory(np.arange(60.0), np.zeros((60, 0)), y[:, None], spec)
    for bins in (10, 4):
        found = reliability(MdpModel(spec, table, np.ones((3, 1))), data, bins=bins)
        events: dict[int, list[tuple[float, bool]]] = {}
        for now, then in zip(y[:-1].astype(int), y[1:].astype(int), strict=True):
            for category in range(3):
                chance = float(table[now, 0, category])
                place = bins - 1 if chance == 1.0 else int(chance * bins)
                events.setdefault(place, []).append((chance, category == then))
        rows = [np.mean(events[place], axis=0) for place in sorted(events)]
        assert found.forecast == pytest.approx([row[0] for row in rows])
        assert found.happened == pytest.approx([row[1] for row in rows])
        assert found.count.tolist() == [len(events[place]) for place in sorted(events)]
        error = sum(len(events[p]) * abs(row[0] - row[1]) for p, row in zip(sorted(events), rows, strict=True))
        assert found.calibration_error == pytest.approx(error / (59 * 3))


def test_a_score_of_distributions_reads_as_a_sentence() -> None:
    one = np.array([[0.48, 0.52], [0.9, 0.904]])
    found = ProbabilityScore(np.array([-1.5]), np.array([0.2]), np.array([0.5, 0.9]), one, 1, 1, 77, 0)
    assert str(found) == "log score -1.5 nats; 50 % holds 50.0 %, 90 % holds 90.2 % (77 samples)"


def test_a_plant_is_linearised_about_a_point_as_its_equation_says() -> None:
    """A pendulum held at an angle: the eigenvalues are those of theta'' = -(g/l) cos(theta0) theta - c theta'."""
    with pendulum_ode(sample_time=0.02) as plant:
        names = [channel.name for channel in plant.spec.states]
        hanging, upright = (linearise(plant, x0={names[0]: angle}, u0=np.zeros(1)) for angle in (0.0, np.pi))
        slow, fast = (np.log(np.linalg.eigvals(one.a_matrix).astype(complex)) / 0.02 for one in (hanging, upright))
        assert np.prod(slow).real == pytest.approx(-np.prod(fast).real, rel=1e-3)  # g/l changes its sign
        assert np.sum(slow).real == pytest.approx(np.sum(fast).real, rel=1e-3)  # damping does not
        assert linearise(plant).a_matrix == pytest.approx(hanging.a_matrix)
        assert linearise(plant, size=1e-5).a_matrix == pytest.approx(hanging.a_matrix, abs=1e-6)


def test_a_regulator_that_just_does_not_settle_is_unstable() -> None:
    plant = LinearPlantModel(1.1 * EYE[:1, :1], EYE[:1, :1], EYE[:1, :1], np.zeros((1, 1)))
    with pytest.raises(InputError, match=r"expected 1 inputs and 1 outputs, got 2 and 1"):
        control_score(LinearPlantModel(EYE, EYE, EYE[:1], np.zeros((1, 2))), plant)
    q, r, sensor = (np.array([[value]]) for value in (2.0, 0.5, 0.1))
    model = LinearPlantModel(1.05 * EYE[:1, :1], 0.9 * EYE[:1, :1], EYE[:1, :1], np.zeros((1, 1)))

    def cost(a: float, b: float) -> float:
        gain = lqr(np.array([[a]]), np.array([[b]]), q, r)[0][0, 0]
        p = linalg.solve_discrete_are(np.array([[a]]), np.array([[1.0]]), np.array([[b * b]]), sensor)[0, 0]
        watch = a * p / (p + 0.1)
        loop = np.array([[1.1, -gain], [watch, a - b * gain - watch]])
        covariance = linalg.solve_discrete_lyapunov(loop, np.diag([1.0, 0.1 * watch**2]))
        return float(2.0 * covariance[0, 0] + 0.5 * gain**2 * covariance[1, 1])

    found = control_score(model, plant, q=q, r=r, sensor=sensor)
    assert found.ratio == pytest.approx(cost(1.05, 0.9) / cost(1.1, 1.0), rel=1e-6)
    pulse = 1.0 + 1.1**2  # of one sample, then the next
    given = {"q": np.array([[1.0 / pulse]]), "r": EYE[:1, :1], "sensor": np.array([[1e-4 * pulse]])}
    assert control_score(model, plant).ratio == pytest.approx(control_score(model, plant, **given).ratio, rel=1e-9)
    worse = control_score(model, plant, **{**given, "sensor": 1.5 * given["sensor"]}).ratio
    assert worse != pytest.approx(control_score(model, plant).ratio, rel=1e-9)
