"""Free parameters of several conditions in one vector, and their likelihood."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import DELAYS
from armperturb.analysis.fit.emg_likelihood import DELAY_NAME, N_ARM
from armperturb.analysis.fit.group import Group, Method
from armperturb.analysis.fit.likelihood import Likelihood
from armperturb.analysis.fit.structures import GAINS, PUBLISHED, unit
from armperturb.analysis.fit.trial_effects import QUANTITIES, SINGULAR, TrialScore, inverse, scaled
from armperturb.analysis.fit.trials_with_emg import TrialsWithEmg
from armperturb.analysis.fit.whittle import LackOfFit, Normal
from armperturb.analysis.manipulator import manipulator_covariance
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.subject import Subject

STABILISING = (0.0, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Shares of the default start that are mixed into an unstable one until it is stable [-]."""

CALMING = (0.75, 0.5, 0.25, 0.1, 0.0)
"""Shares of its feedback gains that are left to a start where even the default one is unstable [-]."""

PART_OF = 1e-3
"""Share of a direction of parameters from which on a parameter belongs to it [-]."""

SHARES: Mapping[str, list[str]] = PUBLISHED["shares"]
"""Names for parameters that are shared together; single ones are named as they are."""


Effects = Sequence[Array]
"""Of each likelihood, by how much quantities are larger in a trial than on average [-], (trial, quantity)."""


class JointLikelihood:
    """Free parameters of all groups in one vector, and their likelihood.

    Attributes:
      groups: the trials.
      method: of the likelihood.
      parts: of which group each likelihood is, and the likelihood.
      names: of the free parameters.
      columns: of each group's free parameters among these.
      of_emg: of what its EMG asks for beside the arm.
      lower: least value of each, (parameter,).
      upper: largest value of each, (parameter,).
      quick: whether derivatives are, see `Likelihood.normal`.
    """

    def __init__(self, groups: Sequence[Group], method: Method, share: Sequence[str], *, sketchy: bool = False) -> None:
        self.groups, self.method, self.quick = tuple(groups), method, sketchy
        every = [
            (at, TrialsWithEmg(likelihood, group.emg) if group.emg else likelihood, trials)
            for at, group in enumerate(self.groups)
            for likelihood, trials in _likelihoods(group, method, sketchy)
        ]
        self.parts = [(at, likelihood) for at, likelihood, _ in every]
        self._trials = [trials for _, _, trials in every]
        shared = shared_names(self.groups, share)
        self.names: list[str] = []
        self.columns: list[list[int]] = []
        self.of_emg: list[list[int]] = []
        for group in self.groups:
            for names, of_groups in ((group.structure.free, self.columns), (names_of_emg(group), self.of_emg)):
                mine = []
                for name in names:
                    label = name if len(self.groups) == 1 or name in shared else f"{name} [{group.label}]"
                    if label not in self.names:
                        self.names.append(label)
                    mine.append(self.names.index(label))
                of_groups.append(mine)
        self.lower, self.upper = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for group, columns in zip(self.groups, self.columns, strict=True):
            lower, upper = np.array([group.structure.bounds[name] for name in group.structure.free]).T
            self.lower[columns] = np.maximum(self.lower[columns], lower)
            self.upper[columns] = np.minimum(self.upper[columns], upper)
        for group, columns in zip(self.groups, self.of_emg, strict=True):
            if group.emg:
                self.lower[columns], self.upper[columns] = np.array([*group.emg.bounds.values()]).T
        for name, lower, upper in zip(self.names, self.lower, self.upper, strict=True):
            if not lower < upper:
                raise ValueError(f"bounds of the shared {name} cross ({lower:g} to {upper:g}); expected some overlap")
        self._known, self._sharpness = np.zeros(len(self.names)), np.zeros(len(self.names))
        for group, columns in zip(self.groups, self.columns, strict=True):
            for name, (mean, sd) in group.structure.prior.items():
                column = columns[group.structure.free.index(name)]
                self._known[column], self._sharpness[column] = mean, sd**-2
        for group, columns in zip(self.groups, self.of_emg, strict=True):
            for name, (mean, sd) in (group.emg.prior if group.emg else {}).items():
                column = columns[names_of_emg(group).index(name)]
                self._known[column], self._sharpness[column] = mean, sd**-2
        self._mixing = [self._mixing_of(group) for group in self.groups]
        self._arms = [LinearArm(group.body, ()) for group in self.groups]

    @staticmethod
    def _mixing_of(group: Group) -> Array:
        """Derivative of a likelihood's parameters by a group's columns and what EMG asks for beside them."""
        mixing = group.structure.mixing
        return linalg.block_diag(mixing, np.eye(len(group.emg.names))) if group.emg else mixing

    def _of(self, at: int) -> list[int]:
        """Columns of a group and of its EMG, in the order of `_mixing_of`."""
        return [*self.columns[at], *self.of_emg[at]]

    @property
    def is_long(self) -> bool:
        """Whether derivatives that are not quick take long."""
        return any(likelihood.is_long for _, likelihood in self.parts)

    @property
    def uses_emg(self) -> bool:
        """Whether EMG counts in any group."""
        return any(self.of_emg)

    def initial(self, given: Mapping[str, float]) -> Array:
        """Given values, and where there is none the mean over the groups of where linear least squares would start."""
        is_whole = set(self.names) <= given.keys()
        values = np.zeros(len(self.names)) if is_whole else self._started([group.initial for group in self.groups])
        for name, value in given.items():
            if name not in self.names:
                raise ValueError(f"initial: unknown parameter {name!r}; expected {', '.join(self.names)}")
            column = self.names.index(name)
            lower, upper = self.lower[column], self.upper[column]
            if not lower <= value <= upper:
                raise ValueError(
                    f"initial: {name} = {value!r}; expected {lower:g} to {upper:g} {unit(name.split()[0])}"
                )
            values[column] = value
        return values

    def _mean(self, of_groups: Sequence[ArrayLike]) -> Array:
        total, count = np.zeros(len(self.names)), np.zeros(len(self.names))
        for columns, values in zip(self.columns, of_groups, strict=True):
            total[columns] += np.asarray(values)
            count[columns] += 1.0
        return np.clip(total / np.maximum(count, 1.0), self.lower, self.upper)

    def _started(self, of_groups: Sequence[ArrayLike]) -> Array:
        """Means over the groups, and what EMG asks for beside the arm as it follows from these."""
        values = self._mean(of_groups)
        starts: dict[int, list[float]] = {}
        for at, group in enumerate(self.groups):
            if group.emg:
                arm = group.structure.parameters(group.body.task, values[self.columns[at]])
                for column, value in zip(self.of_emg[at], group.emg.start(arm), strict=True):
                    starts.setdefault(column, []).append(float(value))
        for column, of_column in starts.items():
            values[column] = np.mean(of_column)
        return values

    def parameters(self, values: Array, effects: Effects | None = None) -> list[Array]:
        """Parameters of the arm for each likelihood, (parameter,); with effects of trials (trial, parameter).

        Where there is EMG, what it asks for follows.
        """
        by_likelihood = []
        for number, (at, _) in enumerate(self.parts):
            group, free_values = self.groups[at], values[self.columns[at]]
            of_emg = values[self.of_emg[at]]
            if effects is None:
                by_likelihood.append(np.append(group.structure.parameters(group.body.task, free_values), of_emg))
                continue
            change = effects[number] @ self._design(at, values)[: len(free_values)].T
            arms = [group.structure.parameters(group.body.task, free_values + each) for each in change]
            by_likelihood.append(np.array([np.append(arm, of_emg) for arm in arms]))
        return by_likelihood

    def _design(self, at: int, values: Array) -> Array:
        """Change of parameters, as `_of` orders them, per relative change of a quantity, (parameter, quantity)."""
        free = [self.names[column].partition(" ")[0] for column in self._of(at)]
        of_quantity = [{f"{quantity}_{joint}" for joint in ("s", "se", "e")} for quantity in QUANTITIES]  # no grip
        of = np.array([[name in members for members in of_quantity] for name in free])
        return np.asarray(of * values[self._of(at), None])

    def no_effects(self) -> Effects:
        """Trials that are all alike."""
        return [np.zeros((likelihood.n_trials, len(QUANTITIES))) for _, likelihood in self.parts]

    @property
    def n_trials(self) -> int:
        """Of all groups together."""
        return sum(likelihood.n_trials for _, likelihood in self.parts)

    @property
    def are_independent(self) -> bool:
        """Whether every trial has a perturbation of its own, so that trials of one arm differ in its nonlinearity."""
        return all(part.are_independent for group in self.groups for part in group.parts)

    def arms(self, values: Array) -> list[Subject]:
        """The arm of each group."""
        return [
            group.structure.arm(group.body, values[columns])
            for group, columns in zip(self.groups, self.columns, strict=True)
        ]

    def pole(self, values: Array) -> float:
        """Largest real part of a pole of any arm on its environment [1/s]."""
        # Of what is no arm, too, as a search may ask for a joint inertia that is not positive.
        every = zip(self._arms, self.groups, self.columns, strict=True)
        return max(
            float(arm.poles(group.structure.parameters(group.body.task, values[columns]), group.environment).real.max())
            for arm, group, columns in every
        )

    def _with_parameters(
        self, values: Array, effects: Effects | None
    ) -> Iterator[tuple[Likelihood | TrialsWithEmg, Array]]:
        likelihoods = (likelihood for _, likelihood in self.parts)
        return zip(likelihoods, self.parameters(values, effects), strict=True)

    def weigh(self, values: Array, effects: Effects | None = None) -> None:
        """Estimate the noise at these parameters; it holds until the next call."""
        for likelihood, parameters in self._with_parameters(values, effects):
            likelihood.weigh(parameters)

    def cost(self, values: Array, effects: Effects | None = None) -> float:
        """Sum of squares of the white residual, and of the distance from what is known beside the trials."""
        every = self._with_parameters(values, effects)
        return sum((likelihood.cost(parameters) for likelihood, parameters in every), self._distance(values))

    def objective(self, values: Array) -> float:
        """Minus twice the log-likelihood, or posterior probability where something is known, up to a constant."""
        every = self._with_parameters(values, None)
        return sum((likelihood.objective(parameters) for likelihood, parameters in every), self._distance(values))

    def _distance(self, values: Array) -> float:
        """Squared distance from what is known beside the trials, in standard deviations."""
        return float(self._sharpness @ (values - self._known) ** 2)

    def normal(self, values: Array) -> Normal:
        """Normal equations of a Gauss-Newton step, of all likelihoods together."""
        cost, slope = self._distance(values), (self._sharpness * (self._known - values))[None]
        information = np.diag(self._sharpness)[None].copy()
        for (at, likelihood), parameters in zip(self.parts, self.parameters(values), strict=True):
            of_part = likelihood.step_normal if self.quick else likelihood.normal
            part, columns = of_part(parameters, self._mixing[at]), self._of(at)
            cost += part.cost
            slope[0, columns] += part.slope
            information[0][np.ix_(columns, columns)] += part.information
        return Normal(cost, slope, information)

    def scores(self, values: Array, effects: Effects) -> list[TrialScore]:
        """What each trial tells, about trials with these effects; last, as one that has none, what is known beside."""
        by_trial = []
        every = zip(self.parts, self.parameters(values, effects), effects, strict=True)
        for (at, likelihood), parameters, of_trials in every:
            part = likelihood.normal(parameters, self._mixing[at], quick=self.quick)
            design = self._design(at, values)
            for slope, information, effect in zip(part.slopes, part.informations, of_trials, strict=True):
                score = slope + information @ (design @ effect)
                by_trial.append(TrialScore(self._of(at), score, information, design))
        if self._sharpness.any():
            score, design = self._sharpness * (self._known - values), np.zeros((len(values), len(QUANTITIES)))
            by_trial.append(TrialScore(range(len(values)), score, np.diag(self._sharpness), design))
        return by_trial

    def emg_delay(self, values: Array, effects: Effects | None = None) -> tuple[float, float]:
        """By how much later than their EMG muscles answer, beyond what is assumed, and the standard error [s].

        A Gauss-Newton step of that delay alone from most likely values, the other parameters following it; the noise
        must have been weighed. NaN and infinity where no EMG tells, or where that delay is free.
        """
        n, slope = len(self.names), 0.0
        information, together = np.diag(self._sharpness), np.zeros(n + 1)
        for (at, likelihood), parameters in zip(self.parts, self.parameters(values, effects), strict=True):
            mixing, columns = self._mixing[at], self._of(at)
            information[np.ix_(columns, columns)] += likelihood.normal(parameters, mixing, quick=True).information
            if isinstance(likelihood, TrialsWithEmg) and DELAY_NAME not in likelihood.emg.names:
                # What is later by the electromechanical delay is as if the reflexes' delays were shorter, in EMG alone.
                earlier = np.zeros(len(mixing))
                earlier[DELAYS] = -1.0
                of_emg = likelihood.emg.normal(parameters, np.column_stack([mixing, earlier]), quick=True)
                slope += of_emg.slope[-1]
                together[[*columns, n]] += of_emg.information[-1]
        inside = np.flatnonzero((values > self.lower) & (values < self.upper))
        follows = inverse(information[np.ix_(inside, inside)]) @ together[inside]
        alone = together[n] - together[inside] @ follows
        return (slope / alone, alone**-0.5) if alone > SINGULAR * together[n] > 0.0 else (np.nan, np.inf)

    def lack_of_fit(self, values: Array, effects: Effects | None = None) -> LackOfFit:
        """Of all groups together; the noise must have been weighed."""
        every = self._with_parameters(values, effects)
        parts = [likelihood.lack_of_fit(parameters) for likelihood, parameters in every]
        dof = sum(part.dof for part in parts) - len(self.names)
        return LackOfFit(sum(part.chi2 for part in parts), max(dof, 1))

    def lack_of_emg(self, values: Array, effects: Effects | None = None) -> LackOfFit | None:
        """The part of `lack_of_fit` that EMG has; None where none counts."""
        every = self._with_parameters(values, effects)
        parts = [
            likelihood.emg.lack_of_fit(of_its) for likelihood, of_its in every if isinstance(likelihood, TrialsWithEmg)
        ]
        return LackOfFit(sum(part.chi2 for part in parts), sum(part.dof for part in parts)) if parts else None

    def added_covariance(self, values: Array) -> Array:
        """What errors of the noise and of the manipulators add to the variance of estimates, (parameter, parameter).

        The noise is estimated from the residual, see `whittle`; each condition's manipulator is identified from its own
        trials, and then counts as known. The noise must have been weighed. Trials are taken to be alike.
        """
        known = np.diag(self._sharpness)
        left, slopes = known.copy(), []
        for number, parameters in enumerate(self.parameters(values)):
            (at, likelihood), trials = self.parts[number], self._trials[number]
            mixing, columns = self._mixing[at], self._of(at)
            for total, part in zip((known, left), likelihood.informations(parameters, mixing), strict=True):
                total[np.ix_(columns, columns)] += part
            movement = likelihood.movement if isinstance(likelihood, TrialsWithEmg) else likelihood
            slope = np.zeros((len(self.names), 3))
            slope[columns] = errors_by_manipulator(movement, trials, parameters[:N_ARM], mixing[:N_ARM])
            slopes.append(slope)
        by_manipulators = inverse(known) @ np.concatenate(slopes, axis=1)
        return inverse(left) - inverse(known) + by_manipulators @ by_manipulators.T

    def published(self) -> Array:
        """Mean over the groups of the structures' default starts."""
        return self._started(
            [[group.structure.initial[name] for name in group.structure.free] for group in self.groups]
        )

    def nearest(self) -> Array:
        """Mean over the groups of the best fits to their estimated admittances, from several starts."""
        return self._started([group.best_fit_of_spectra()[0] for group in self.groups])

    def stabilised(self, values: Array) -> Array:
        """The values moved towards the structures' default starts until every arm is stable.

        Where even these starts are unstable, as other delays or cut-offs than the published ones may make them, the
        values get less feedback, then the starts; the starts as they are if that is not enough.
        """
        published = self.published()
        is_gain = np.array([name.startswith(GAINS) for name in self.names])
        mixed = ((1.0 - share) * values + share * published for share in STABILISING)
        calmed = (np.where(is_gain, share * each, each) for each in (values, published) for share in CALMING)
        within = (np.clip(each, self.lower, self.upper) for each in itertools.chain(mixed, calmed))
        return next((each for each in within if self.pole(each) < 0.0), published)

    def require_identifiable(self, values: Array) -> None:
        """Refuse structures in which some direction of the parameters changes no movement.

        What has no effect at these values may have some elsewhere, as a delay has none without gains: only what has
        none at the structures' default starts either is refused.

        Raises:
          ValueError: there is such a direction.
        """
        information = np.zeros((len(self.names), len(self.names)))
        for place in (values, self.published()):
            self.weigh(place)
            information += self.normal(place).information
            if scaled(information)[1][0] > SINGULAR:
                return
        try:
            require_informative(information, self.names)
        except ValueError as error:
            raise ValueError(f"{', '.join(group.label for group in self.groups)}: {error}") from None


def errors_by_manipulator(likelihood: Likelihood, trials: ConditionTrials, values: Array, mixing: Array) -> Array:
    """By how much errors of the manipulator, of one standard error each, change the score, (parameter, error).

    The noise must have been weighed.

    Args:
      likelihood: of the trials.
      trials: in which the manipulator was identified.
      values: parameters of the arm.
      mixing: their derivative by the free ones, (arm's parameter, parameter).
    """
    slope = likelihood.errors_by(values, mixing, likelihood.by_manipulator(values, *trials.instruments))
    variances, directions = np.linalg.eigh(manipulator_covariance(trials))
    return np.asarray(slope @ directions * np.sqrt(np.maximum(variances, 0.0)))


def _likelihoods(group: Group, method: Method, sketchy: bool) -> Iterable[tuple[Likelihood, ConditionTrials]]:
    """Each likelihood of a group, and its trials."""
    if method == "frequency":
        return [] if group.period is None else [(group.period, group.parts[0])]
    return zip(group.segments if sketchy else group.records, group.of_records, strict=True)


def names_of_emg(group: Group) -> tuple[str, ...]:
    """What the EMG of a group asks for beside the arm."""
    return group.emg.names if group.emg else ()


def require_informative(information: Array, names: Sequence[str]) -> None:
    """Refuse information that leaves some direction of the parameters unknown.

    Args:
      information: Fisher information, (parameter, parameter).
      names: of the parameters.

    Raises:
      ValueError: there is such a direction; the message names it.
    """
    scale, power, directions = scaled(information)
    if power[0] > SINGULAR:
        return
    silent = [name for name, size in zip(names, np.diag(information), strict=True) if not size > 0.0]
    if silent:
        raise ValueError(f"{', '.join(silent)} cannot be identified: no effect on the movement; expected fixed values")
    weak = directions[:, 0] / scale
    weak /= np.abs(weak).max()
    terms = [f"{w:+.2g} {name}" for w, name in zip(weak, names, strict=True) if abs(w) > PART_OF]
    raise ValueError(
        f"the structure cannot be identified: a change of {' '.join(terms)} leaves the movement as it is; "
        "expected one of them fixed"
    )


def shared_names(groups: Sequence[Group], share: Sequence[str]) -> set[str]:
    """Parameters that the groups share.

    Raises:
      ValueError: a name is of no free parameter.
    """
    known = {name for group in groups for name in (*group.structure.free, *names_of_emg(group))}
    shared: set[str] = set()
    for name in share:
        names = [member for member in SHARES.get(name, [name]) if member in known]
        if not names:
            raise ValueError(f"share: {name!r} is no free parameter; expected {', '.join((*SHARES, *sorted(known)))}")
        shared.update(names)
    return shared
