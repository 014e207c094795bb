"""What a multisine will tell about an arm, and which line powers tell most (experiment design).

A line of frequency f and power p on one axis (mean square force, A^2 / 2), played for T seconds, adds to the Fisher
information

    2 T p Re(P_i^H Phi^-1 P_j),    P_i = dP / dtheta_i (column of that axis),

where x = P(theta) d + v, and Phi is the one-sided spectrum of v, (axis, axis). What x and y do together adds nothing on
average over their phases, which are independent. The noise v is that of the person and of the instruments,

    Phi = G S G^H + 1 / (1 / s_x + |E^-1|^2 / s_f),    G = P H^-1 J Z^-1,

with the torque spectrum S of the person, and s_x and s_f of encoders and gauge, which are averaged as
`Balance.displacement` averages them. S rises with the RMS torque that the perturbation puts on the joints (the demand).

With the noise held, information is linear in the powers. The criterion is the mean logarithm of the standard errors of
some parameters, all others being unknown too. Each is -log(1 / (I^-1)_ii) / 2; 1 / (I^-1)_ii, a Schur complement, is
concave in I, so that the criterion is convex in the powers: under linear limits (mean square force, displacement and
demand) an interior-point method finds the least value there is. If the noise is to follow the demand, which is linear
in the powers too, what it costs is priced by its slope, the convex problem solved again from there, and a step taken
towards its solution, until the price is right. That ends at a stationary point of the whole problem.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.linear_arm import LinearArm, environment_admittance
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.fit.joint_likelihood import require_informative
from armperturb.analysis.fit.likelihood import TAPER
from armperturb.analysis.fit.structures import Structure
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.smoother import NoiseLevels
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.subject import Subject

TOLERANCE = 1e-4
"""By how much the mean logarithm of the standard errors may exceed the least possible [-]."""

GROWTH = 10.0
"""Factor from barrier to barrier of the interior-point method [-]."""

LEAST_RATIO = 0.01
"""Share of the other axis's mean square force that each axis has at least [-]: an optimum may want next to none, with
which recordings would not show the admittance in that direction, nor the person's departures from the model."""

LEAST_STEP = 1e-3
"""Share of the way to the solution with the noise held below which no step is tried [-]."""

MAX_STEPS = 60
"""Newton steps per barrier, and rounds in which the price of the noise is set."""


class Noise(NamedTuple):
    """What is recorded beside the answer to the perturbation.

    Attributes:
      floor: one-sided spectrum of the person's torque at each joint without a perturbation [Nm^2/Hz], (frequency,).
      slope: its rise with the square of the demand of that joint [1/Hz], (frequency,).
      instruments: standard deviations of a sample.
      rate: of the samples [Hz].
    """

    floor: Array
    slope: Array
    instruments: NoiseLevels
    rate: float


def effective_duration(duration: float) -> float:
    """Length of a record without edges that tells as much as one of this duration does [s].

    The likelihood of whole records leaves out the last half second, and fades out before it: with weights w each power
    comes with weight w^2, and its variance with w^4, so that (sum w^2)^2 / sum w^4 counts.

    Args:
      duration: of a trial that starts at rest [s].
    """
    whole = duration - EDGE - TAPER
    # Means over half a raised cosine: 3/8 of its square, 35/128 of its fourth power.
    return float((whole + TAPER * 3 / 8) ** 2 / (whole + TAPER * 35 / 128))


class Experiment:
    """An arm on its environment, its noise, and what lines at some frequencies tell about its parameters.

    Powers are mean square forces of the lines [N^2], (frequency, axis).

    Args:
      arm: the person, whose linear parameters are taken for true.
      structure: what is estimated.
      environment: what the hand holds.
      frequency: of the lines [Hz], (frequency,).
      noise: at these frequencies.

    Attributes:
      frequency: of the lines [Hz], (frequency,).
      names: of the free parameters.
    """

    def __init__(
        self, arm: Subject, structure: Structure, environment: Environment, frequency: Array, noise: Noise
    ) -> None:
        model, values = LinearArm(arm, frequency), parameter_vector(arm)
        self.frequency, self.names, self._noise = frequency, structure.free, noise
        total, gradient = model.total_and_gradient(values, environment)
        self._gradient = gradient @ structure.mixing
        self._jacobian = hand_jacobian(arm)
        to_hand, to_joints = (
            np.linalg.inv(matrix) for matrix in (model.admittance(values), model.joint_impedance(values))
        )
        self._own = total @ to_hand @ self._jacobian @ to_joints
        self._total = total
        held = 1.0 / np.abs(environment_admittance(environment, frequency)[:, 0, 0]) ** 2
        gauge, encoder = (2.0 * level**2 / noise.rate for level in noise.instruments)
        self._instruments = gauge * encoder / (gauge + held * encoder)

    def demand(self, power: Array) -> Array:
        """Mean square torque with which lines load each joint [Nm^2], (joint,)."""
        return np.asarray(np.sum(power, axis=0) @ self._jacobian**2)

    def displacement(self, power: Array) -> Array:
        """Mean square displacement of the handle that the lines cause, (axis,) [m^2]."""
        return np.asarray(np.einsum("foi,fi->o", np.abs(self._total) ** 2, power))

    def noise(self, demand: Array) -> ComplexArray:
        """One-sided spectrum of what is beside the answer in the displacement [m^2/Hz], (frequency, axis, axis).

        Args:
          demand: mean square torque with which the perturbation loads each joint [Nm^2], (joint,).
        """
        torque = self._noise.floor[:, None] + self._noise.slope[:, None] * demand
        spectrum = np.einsum("fij,fj,fkj->fik", self._own, torque, self._own.conj())
        return np.asarray(spectrum + self._instruments[:, None, None] * np.eye(2))

    def information(self, power: Array, demand: Array | None = None) -> Array:
        """Fisher information per second, (parameter, parameter).

        Args:
          power: of the lines [N^2], (frequency, axis).
          demand: for which the person is as noisy [Nm^2], (joint,); that of the lines if None.
        """
        parts = self.parts(self.demand(power) if demand is None else demand)
        return np.asarray(np.einsum("fa,faij->ij", power, parts))

    def parts(self, demand: Array) -> Array:
        """Fisher information per second and N^2 of each line, (frequency, axis, parameter, parameter)."""
        weighted = np.linalg.solve(self.noise(demand)[:, None], self._gradient.swapaxes(1, 2))
        return np.asarray(2.0 * np.einsum("foai,faoj->faij", self._gradient.conj(), weighted).real)

    def slopes(self, power: Array, demand: Array) -> Array:
        """Derivative of the information per second of lines by the demand, (joint, parameter, parameter)."""
        weighted = np.linalg.solve(self.noise(demand), self._own)
        felt = np.einsum("foj,foai->fjai", weighted.conj(), self._gradient)
        return np.asarray(-2.0 * np.einsum("f,fa,fjai,fjak->jik", self._noise.slope, power, felt.conj(), felt).real)

    def answer(self, force: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Displacement that a force causes, and its derivative by each free parameter.

        Args:
          force: Fourier transform at the frequencies of the lines, (frequency, axis).

        Returns:
          Likewise, (frequency, axis) and (frequency, axis, parameter).
        """
        return (
            np.asarray(np.einsum("foa,fa->fo", self._total, force)),
            np.asarray(np.einsum("foai,fa->foi", self._gradient, force)),
        )

    def standard_error(self, information: Array, duration: float, trials: int = 1) -> Array:
        """Least standard error of each parameter (Cramer-Rao), (parameter,), SI.

        Args:
          information: per second, (parameter, parameter).
          duration: of each trial [s].
          trials: how many there are, each with phases of its own.

        Raises:
          ValueError: there is none about some parameter, or direction of parameters; the message names it.
        """
        whole = information * effective_duration(duration) * trials
        require_informative(whole, self.names)
        return np.asarray(np.sqrt(np.diag(_inverse(whole))))


class Limits(NamedTuple):
    """What a multisine must keep.

    Attributes:
      force: largest RMS force per axis [N], the same of both or (axis,).
      displacement: largest RMS displacement of the handle per axis that it causes, on average over phases [m].
    """

    force: float | Array
    displacement: float


class Optimum(NamedTuple):
    """The best multisine.

    Attributes:
      power: of its lines [N^2], (frequency, axis).
      excess: by how much the mean logarithm of the standard errors would fall within the limits if it fell all the way
        as steeply as it does here [-]. With the noise held it is convex, and cannot fall further: a bound of how far it
        is from the least. With the noise following the demand it says that the point is stationary.
    """

    power: Array
    excess: float


class _Shares:
    """The problem in shares of some mean square force that the limits allow, one per cluster and axis, x first.

    Attributes:
      experiment: at the lines of the clusters.
      goal: columns of the parameters that count.
      limits: what the shares must keep: limits @ share <= bounds, (limit, share).
      bounds: of these limits [-], (limit,).
      spreading: shares to powers of the lines [N^2], (frequency, axis, share).
      demand: shares to the demand [Nm^2], (joint, share).
      held: demand for which the person is as noisy, whatever the shares [Nm^2], (joint,); None for that of the shares.
    """

    def __init__(
        self,
        experiment: Experiment,
        clusters: int,
        goal: Sequence[str],
        limits: Limits,
        spread: float,
        held: Array | None,
        least_ratio: float | None,
    ) -> None:
        self.experiment, self.held = experiment, held
        self.goal = [experiment.names.index(name) for name in goal]
        n_lines = len(experiment.frequency) // clusters
        even = np.kron((1.0 - spread) * np.eye(clusters) + spread / clusters, np.full((n_lines, 1), 1.0 / n_lines))
        spreading = np.zeros((clusters * n_lines, 2, 2 * clusters))
        most = np.broadcast_to(limits.force, 2) ** 2
        spreading[:, 0, :clusters], spreading[:, 1, clusters:] = (each * even for each in most)
        columns = np.moveaxis(spreading, 2, 0)
        force = np.array([column.sum(axis=0) for column in columns]).T
        displacement = np.array([experiment.displacement(column) for column in columns]).T / limits.displacement**2
        demand = np.array([experiment.demand(column) for column in columns]).T
        allowed = np.concatenate(
            [force / most[:, None], displacement, *([] if held is None else [demand / held[:, None]])]
        )
        # In shares of about one, where limits other than that of the force allow far less than it.
        unit = 1.0 / max(1.0, float(allowed.max(axis=0).min()))
        floors = (
            np.empty((0, 2 * clusters)) if least_ratio is None else (least_ratio * force - force[::-1]) / most.max()
        )
        self.limits = unit * np.concatenate([allowed, floors])
        self.bounds = np.concatenate([np.ones(len(allowed)), np.zeros(len(floors))])
        self.spreading, self.demand = unit * spreading, unit * demand

    def room(self, share: Array) -> Array:
        """What is left of each limit at these shares [-], (limit,)."""
        return np.asarray(self.bounds - self.limits @ share)

    def power(self, share: Array) -> Array:
        return np.asarray(self.spreading @ share)

    def parts(self, share: Array) -> Array:
        """Information per share with the noise as it is at these shares, (share, parameter, parameter)."""
        demand = self.demand @ share if self.held is None else self.held
        return np.einsum("faij,fas->sij", self.experiment.parts(demand), self.spreading, optimize=True)

    def price(self, share: Array) -> Array:
        """By how much the criterion rises with each share because the noise does, (share,)."""
        if self.held is not None:
            return np.zeros_like(share)
        slopes = self.experiment.slopes(self.power(share), self.demand @ share)
        return -_weight(_covariance(self.parts(share), share), self.goal, slopes) @ self.demand

    def criterion(self, share: Array) -> float:
        """Mean logarithm of the goal's standard errors from a second."""
        return 0.5 * float(np.mean(np.log(np.diag(_covariance(self.parts(share), share))[self.goal])))


def optimise(
    experiment: Experiment, clusters: int, goal: Sequence[str], limits: Limits, spread: float, held: Array | None = None
) -> Optimum:
    """Powers of lines that make the geometric mean of some parameters' standard errors least.

    Args:
      experiment: at the frequencies of the lines, which form clusters of equal power: the lines of the first cluster
        first, as many in each.
      clusters: how many clusters there are.
      goal: names of the parameters whose errors count.
      limits: on force and displacement; each axis has at least `LEAST_RATIO` of the other's mean square force besides.
      spread: share of each axis's power that is spread evenly over all clusters, 0 to 1.
      held: demand [Nm^2], (joint,), that the lines must keep, and for which the person is as noisy, also under less;
        None lets the noise follow the demand, which then has no limit.

    Raises:
      ValueError: no multisine at these lines tells about all parameters; the message names those.
    """
    # What keeps it without being asked is the optimum with it, too.
    optimum = _optimum(_Shares(experiment, clusters, goal, limits, spread, held, None), clusters)
    force = optimum.power.sum(axis=0)
    if force.min() >= LEAST_RATIO * force.max():
        return optimum
    return _optimum(_Shares(experiment, clusters, goal, limits, spread, held, LEAST_RATIO), clusters)


def _optimum(problem: _Shares, clusters: int) -> Optimum:
    share = np.full(2 * clusters, 0.5 / (2 * clusters))
    share *= 0.5 / max(float(np.max(problem.limits @ share)), 0.5)
    require_informative(np.einsum("sij,s->ij", problem.parts(share), share), problem.experiment.names)
    best, excess = problem.criterion(share), _excess(problem, share)
    for _ in range(MAX_STEPS):
        if excess < TOLERANCE:
            break
        aim = _least(problem, share)
        step = 1.0
        while (now := problem.criterion(moved := (1.0 - step) * share + step * aim)) >= best and step > LEAST_STEP:
            step /= 2.0
        if now >= best:
            break
        share, best, excess = moved, now, _excess(problem, moved)
    return Optimum(problem.power(share), excess)


def _excess(problem: _Shares, share: Array) -> float:
    """By how much the criterion could fall along its slope within the limits [-]."""
    parts = problem.parts(share)
    slope = problem.price(share) - _weight(_covariance(parts, share), problem.goal, parts)
    furthest = optimize.linprog(slope, A_ub=problem.limits, b_ub=problem.bounds)
    return float(slope @ share - furthest.fun)


def _inverse(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def _covariance(parts: Array, share: Array) -> Array:
    """Covariance of the estimates, from the information per share."""
    return _inverse(np.einsum("sij,s->ij", parts, share))


def _weight(covariance: Array, goal: list[int], parts: Array) -> Array:
    """Minus the derivative of the criterion along each of some changes of the information, (change,)."""
    columns = covariance[:, goal] / np.sqrt(np.diag(covariance)[goal])
    return np.asarray(np.einsum("ig,sij,jg->s", columns, parts, columns, optimize=True) / (2 * len(goal)))


def _least(problem: _Shares, start: Array) -> Array:
    """Shares that make criterion + price @ share least with the noise as it is at the start, (share,).

    By an interior-point method, from a start that is strictly inside the limits, (share,).
    """
    parts, price = problem.parts(start), problem.price(start)
    n, n_bounds = len(start), len(start) + len(problem.limits)
    # From the interior: the last barrier may have left the start at the border of what is allowed.
    share = 0.5 * start + 0.25 / n / max(1.0, float(problem.limits.sum(axis=1).max() / n))
    sharpness = 10.0 * n_bounds
    while True:
        for _ in range(MAX_STEPS):
            value, slope, curvature = _with_barrier(problem, parts, price, share, sharpness)
            step = -np.linalg.solve(curvature, slope)
            if -slope @ step < 1e-2:
                break
            length = 1.0
            while not _barrier(problem, parts, price, share + length * step, sharpness) < value:
                length /= 2.0
                if length < 1e-9:
                    break
            share = share + length * step
        if n_bounds / sharpness < 0.3 * TOLERANCE:
            return share
        sharpness *= GROWTH


def _barrier(problem: _Shares, parts: Array, price: Array, share: Array, sharpness: float) -> float:
    room = problem.room(share)
    if not ((share > 0.0).all() and (room > 0.0).all()):
        return np.inf
    criterion = 0.5 * np.mean(np.log(np.diag(_covariance(parts, share))[problem.goal])) + price @ share
    return float(sharpness * criterion - np.sum(np.log(share)) - np.sum(np.log(room)))


def _with_barrier(
    problem: _Shares, parts: Array, price: Array, share: Array, sharpness: float
) -> tuple[float, Array, Array]:
    """`_barrier`, its slope and its curvature.

    With c the goal's column of the covariance C and u_s = M_s c: the logarithm of C_ii has the slope -c u_s / C_ii and
    the curvature 2 u_s C u_t / C_ii less the product of the slopes.
    """
    covariance = _covariance(parts, share)
    slope, curvature = np.zeros_like(share), np.zeros((len(share), len(share)))
    for place in problem.goal:
        column = covariance[:, place] / np.sqrt(covariance[place, place])
        along = parts @ column
        down = along @ column
        slope -= down
        curvature += 2.0 * (along @ covariance) @ along.T - np.outer(down, down)
    room, limits = problem.room(share), problem.limits
    factor = sharpness / (2 * len(problem.goal))
    slope = factor * slope + sharpness * price - 1.0 / share + limits.T @ (1.0 / room)
    curvature = factor * curvature + np.diag(share**-2.0) + (limits.T / room**2) @ limits
    return _barrier(problem, parts, price, share, sharpness), slope, curvature
