"""Linear models fitted to a drive, with intervals that hold although neighbouring samples are alike.

Samples 20 ms apart share their errors, so the textbook's error of a regression is far too small. Here the
drive is cut into blocks, and the spread of what the blocks say gives the interval: the delete-a-block
jackknife (Künsch 1989), which is the cluster-robust covariance CR3 (Bell and McCaffrey 2002).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.statistics.distributions import between, quantile, sides
from iort_analysis.statistics.signals import MAD_TO_SIGMA, Array, quantum
from iort_contract.messages.analysis import Estimate

BLOCKS = 20
# Tukey's biweight: 95 % as good as least squares for normal errors, and blind to errors above 4.685 sigma.
_TUKEY = 4.685
_ROUNDS = 6
# A reading whose interval is further from the model than this many sigma is an outlier.
_FAR = 4.0
# A model differs from another one if chance does so less often than this.
_CHANCE = 0.01
# Student's t of as many degrees of freedom is as good as normal.
_MANY = 1000
_MOST_STEPS = 12
# The largest condition of the scaled normal equations at which their solution means something.
_CONDITION = 1e10


class Prior(NamedTuple):
    """What is known of a coefficient before the drive: its mean and standard deviation."""

    mean: float
    deviation: float


class Part(NamedTuple):
    """Some coefficients with their covariance. ``given`` is the part of it that is not of the blocks' spread,
    such as a prior's."""

    coefficients: Array
    covariance: Array
    given: Array


class Fit(NamedTuple):
    """The coefficients of a linear model with their covariance; and the residuals, NaN where none is known.

    ``sigma`` is the deviation of a single value from the model, without outliers. ``given`` is the part of
    the covariance that is not of the blocks' spread. ``moved`` is how far the coefficients move without each
    block, from their mean.
    """

    coefficients: Array
    covariance: Array
    residuals: Array
    sigma: float
    given: Array
    moved: Array

    def estimate(self, weights: Array, unit: str) -> Estimate:
        """A weighted sum of the coefficients."""
        whole, given = (float(weights @ one @ weights) for one in (self.covariance, self.given))
        return _estimate(float(weights @ self.coefficients), [whole - given], given, unit)

    def of(self, index: int, unit: str) -> Estimate:
        """One coefficient."""
        return self.estimate(np.eye(len(self.coefficients))[index], unit)

    def part(self, *indices: int) -> Part:
        """Some of the coefficients, for `propagated`; all without indices."""
        chosen = indices or range(len(self.coefficients))
        among = np.ix_(chosen, chosen)
        return Part(self.coefficients[list(chosen)], self.covariance[among], self.given[among])

    def beside(self, others: Sequence[Fit], indices: Sequence[int]) -> Fit:
        """The fit with what other models of the same samples say of some of its coefficients.

        A difference beyond chance, by its own spread over the blocks (Hausman 1978), is an error of the
        model. The variance of two models so far apart is then part of the coefficient's: the interval holds
        both (Draper 1995).
        """
        covariance, given = self.covariance.copy(), self.given.copy()
        for i in indices:
            variance = max((self._apart(other, i) for other in others), default=0.0) ** 2 / 2
            covariance[i, i] += variance
            given[i, i] += variance
        return self._replace(covariance=covariance, given=given)

    def _apart(self, other: Fit, index: int) -> float:
        """The difference of a coefficient from another model's; 0 if chance makes it as large."""
        moved = other.moved[:, index] - self.moved[:, index]
        apart = abs(float(other.coefficients[index] - self.coefficients[index]))
        error = math.sqrt(float(moved @ moved) * (BLOCKS - 1) / BLOCKS)
        return apart if apart > quantile(1 - _CHANCE / 2, BLOCKS - 1) * error else 0.0


def fit(
    columns: Sequence[Array],
    wanted: Array,
    *,
    priors: Mapping[int, Prior] | None = None,
    resolution: float = 0.0,
    shared: bool = False,
) -> Fit | None:
    """Fit ``wanted`` as a sum of columns; None if the drive does not tell the columns apart.

    Rows with a NaN are left out, and outliers weigh nothing. ``priors`` are by a column's index.
    ``resolution`` is the step of the values wanted: a reading of 11.6 V in steps of 0.1 V says that the
    voltage was between 11.55 V and 11.65 V, and no more. Where a battery moves less than a few steps, the
    error of rounding follows the load, and least squares are wrong however many samples there are.
    ``shared`` is for values between two readings each, such as a way between two positions: neighbours share
    the error of the reading between them.
    """
    design = np.stack(columns)
    known = np.isfinite(design).all(axis=0) & np.isfinite(wanted)
    design, y = design[:, known], wanted[known]
    if len(y) < 2 * BLOCKS or len(y) < 4 * len(design):
        return None
    scale = np.sqrt(np.einsum("ij,ij->i", design, design) / len(y))
    if not scale.all():
        return None
    design /= scale[:, None]
    problem = _Problem(design, y, resolution, *_scaled(priors or {}, scale))
    solved = problem.solve()
    if solved is None:
        return None
    coefficients, influence, moved, given, sigma = solved
    residuals = np.full(len(wanted), np.nan)
    residuals[known] = y - coefficients @ design
    sampled = moved.T @ moved * ((BLOCKS - 1) / BLOCKS)
    if shared:
        given = given - _shared(influence, np.flatnonzero(known), np.diag(sampled))
    given = given + np.diag(np.maximum(_rounded(design, y) - np.diag(sampled + given), 0.0))
    moved, given = moved / scale, given / np.outer(scale, scale)
    covariance = sampled / np.outer(scale, scale) + given
    return Fit(coefficients / scale, covariance, residuals, sigma, given, moved)


def propagated(function: Callable[[Array], Any], *parts: Part, unit: str) -> Estimate:
    """A function of the coefficients of independent fits."""
    at = np.concatenate([part.coefficients for part in parts])
    deviations = np.concatenate([np.sqrt(np.diag(part.covariance)) for part in parts])
    steps = np.where(deviations > 0, deviations, 1.0) * 1e-3
    slopes = np.array([(function(at + step) - function(at - step)) for step in np.diag(steps)]) / (2 * steps)
    spread: list[float] = []
    given, first = 0.0, 0
    for part in parts:
        own = slopes[first : first + len(part.coefficients)]
        known = float(own @ part.given @ own)
        spread.append(float(own @ part.covariance @ own) - known)
        given += known
        first += len(part.coefficients)
    return _estimate(float(function(at)), spread, given, unit)


def _estimate(value: float, spread: Sequence[float], given: float, unit: str) -> Estimate:
    """The estimate with its interval: Student's t, since few blocks tell the variances in ``spread``, with
    the degrees of freedom of their sum with what is given (Satterthwaite 1946)."""
    whole = max(sum(spread) + given, 0.0)
    uncertain = sum(variance**2 for variance in spread) / (BLOCKS - 1)
    freedom = round(whole**2 / uncertain) if uncertain > whole**2 / _MANY else math.inf
    half = sides(max(1, freedom)) * math.sqrt(whole)
    return Estimate(value, value - half, value + half, unit)


class _Problem(NamedTuple):
    """The columns of a regression, all of the size 1, and the priors' precisions and means."""

    columns: Array
    y: Array
    resolution: float
    precision: Array
    mean: Array

    def solve(self) -> tuple[Array, Array, Array, Array, float] | None:
        """The coefficients, the rows' influence on them, how far they move without each block, the priors'
        covariance, and sigma."""
        sigma = max(float(np.std(self.y)), 1e-12)
        weights = np.ones(len(self.y))
        coefficients = np.zeros(len(self.columns))
        for _ in range(_ROUNDS):
            weighted = self.columns * (weights / sigma**2)
            total = weighted @ self.columns.T + self.precision
            if np.linalg.cond(total) > _CONDITION:
                return None
            coefficients = np.linalg.solve(total, weighted @ self.y + self.precision @ self.mean)
            residuals = self.y - coefficients @ self.columns
            sigma = max(MAD_TO_SIGMA * _median(np.abs(residuals)), 1e-9, self.resolution / 5)
            weights = _biweight(residuals / sigma)
        score = weights * residuals / sigma**2
        # How fast the scores change with the coefficients: less than the weights, since those change too.
        curve = weights * (_biweight_slope(residuals / sigma) / weights.mean() / sigma**2)
        if self.resolution:
            refined = self._refined(coefficients, max(sigma / 2, self.resolution / 4))
            if refined is None:
                return None
            coefficients, sigma, score, curve = refined
        return coefficients, *self._spread(curve, score), sigma

    def _refined(self, coefficients: Array, sigma: float) -> tuple[Array, float, Array, Array] | None:
        """The most likely coefficients, where each reading stands for an interval (by Newton's steps)."""
        for _ in range(_MOST_STEPS):
            off = self.y - coefficients @ self.columns
            low, high = (off - self.resolution / 2) / sigma, (off + self.resolution / 2) / sigma
            slope, curve, spread = between(low, high)
            near = (low < _FAR) & (high > -_FAR)
            score = np.where(near, slope / sigma, 0.0)
            curve = np.where(near, curve, 0.0) / sigma**2
            total = (self.columns * curve) @ self.columns.T + self.precision
            if np.linalg.cond(total) > _CONDITION:
                return None
            step = np.linalg.solve(total, self.columns @ score - self.precision @ (coefficients - self.mean))
            coefficients = coefficients + step
            wider = spread[near] / sigma
            change = float(wider.sum() / max(float((wider**2).sum()), 1e-12))
            sigma = max(float(np.clip(sigma + change, sigma / 2, sigma * 2)), self.resolution / 50)
            if float(step @ total @ step) < 1e-3 and abs(change) < 0.01 * sigma:
                break
        return coefficients, sigma, score, curve

    def _spread(self, curve: Array, score: Array) -> tuple[Array, Array, Array]:
        # The normal equations of each block.
        starts = np.linspace(0, len(self.y), BLOCKS + 1).astype(np.int64)
        curved, scored = self.columns * curve, self.columns * score
        gram = np.stack([curved[:, a:b] @ self.columns[:, a:b].T for a, b in pairwise(starts)])
        total = gram.sum(axis=0) + self.precision
        scores = np.add.reduceat(scored, starts[:-1], axis=1).T
        # How far the coefficients move without each block.
        moved = np.linalg.solve(total - gram, scores[..., None])[..., 0]
        moved -= moved.mean(axis=0)
        inverse = np.linalg.inv(total)
        return inverse @ scored, moved, inverse @ self.precision @ inverse


def _shared(influence: Array, rows: NDArray[np.intp], variances: Array) -> Array:
    """What the blocks' spread has too much of errors that the rows on either side of a block's end share: at
    most half of its variances, which so few blocks do not tell better."""
    neighbours = np.diff(rows) == 1
    if not neighbours.any():
        return np.zeros((len(influence), len(influence)))
    products = influence[:, :-1][:, neighbours] @ influence[:, 1:][:, neighbours].T / neighbours.sum()
    twice = (1 - BLOCKS) * (products + products.T)
    return np.asarray(twice / max(1.0, float((2 * np.diag(twice) / np.maximum(variances, 1e-300)).max())))


def _rounded(design: Array, y: Array) -> Array:
    """The least variance of each coefficient for values that hardly ever change: readings that stay the same
    share the error of rounding, which no block's spread shows then."""
    plateaus = 1 + np.count_nonzero(np.diff(y))
    if plateaus > BLOCKS:
        return np.zeros(len(design))
    inverse = np.linalg.pinv(design @ design.T)
    return np.asarray(quantum(y) ** 2 / 12 * len(y) / plateaus * np.diag(inverse))


def _scaled(priors: Mapping[int, Prior], scale: Array) -> tuple[Array, Array]:
    """The priors' precisions and means for columns of the size 1."""
    precision, mean = np.full(len(scale), 1e-12), np.zeros(len(scale))
    for index, prior in priors.items():
        precision[index] = 1 / (prior.deviation * scale[index]) ** 2
        mean[index] = prior.mean * scale[index]
    return np.diag(precision), mean


def _median(known: Array) -> float:
    """The median of values without NaN: `np.median` also looks for one, and takes several times as long."""
    middle = len(known) // 2
    parted = np.partition(known, middle)
    upper = float(parted[middle])
    return upper if len(known) % 2 else (float(parted[:middle].max()) + upper) / 2


def _biweight(share: Array) -> Array:
    share = share / _TUKEY
    return np.asarray(np.where(np.abs(share) < 1, (1 - share**2) ** 2, 0.0), dtype=np.float64)


def _biweight_slope(share: Array) -> float:
    square = np.minimum((share / _TUKEY) ** 2, 1.0)
    return float(((1 - square) * (1 - 5 * square)).mean())
