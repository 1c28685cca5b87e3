"""Linear models fitted to a drive, with intervals that hold although neighbouring samples are alike.

Samples 20 ms apart share their errors, so the textbook's error of a regression is far too small. Here the
drive is cut into blocks, and the spread of what the blocks say gives the interval: the delete-a-block
jackknife (Künsch 1989), which is the cluster-robust covariance CR3 (Bell and McCaffrey 2002).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.statistics.intervals import sides
from iort_analysis.statistics.normal import between
from iort_contract.messages.analysis.findings import Estimate

Array = NDArray[np.float64]

BLOCKS = 20
# Tukey's biweight: 95 % as good as least squares for normal errors, and blind to errors above 4.685 sigma.
_TUKEY = 4.685
_ROUNDS = 6
# A reading whose interval is further from the model than this many sigma is an outlier.
_FAR = 4.0
_MOST_STEPS = 12
# The largest condition of the scaled normal equations at which their solution means something.
_CONDITION = 1e10


class Prior(NamedTuple):
    """What is known of a coefficient before the drive: its mean and standard deviation."""

    mean: float
    deviation: float


class Fit(NamedTuple):
    """The coefficients of a linear model with their covariance; and the residuals, NaN where none is known.

    ``sigma`` is the deviation of a single value from the model, without outliers. ``blocks`` is how many
    blocks' spread the covariance is of.
    """

    coefficients: Array
    covariance: Array
    residuals: Array
    sigma: float
    blocks: int = BLOCKS

    def estimate(self, weights: Array, unit: str) -> Estimate:
        """A weighted sum of the coefficients."""
        deviation = float(np.sqrt(weights @ self.covariance @ weights))
        return estimate(float(weights @ self.coefficients), deviation, unit, self.blocks)

    def of(self, index: int, unit: str) -> Estimate:
        """One coefficient."""
        deviation = float(np.sqrt(self.covariance[index, index]))
        return estimate(float(self.coefficients[index]), deviation, unit, self.blocks)


def fit(
    columns: Sequence[Array],
    wanted: Array,
    *,
    priors: Mapping[int, Prior] | None = None,
    resolution: float = 0.0,
    blocks: int = BLOCKS,
) -> Fit | None:
    """Fit ``wanted`` as a sum of columns; None if the drive does not tell the columns apart.

    Rows with a NaN are left out, and outliers weigh nothing. ``priors`` are by a column's index.
    ``resolution`` is the step of the values wanted: a reading of 11.6 V in steps of 0.1 V says that the
    voltage was between 11.55 V and 11.65 V, and no more. Where a battery moves less than a few steps, the
    error of rounding follows the load, and least squares are wrong however many samples there are.
    """
    design = np.stack(columns)
    known = np.isfinite(design).all(axis=0) & np.isfinite(wanted)
    design, y = design[:, known], wanted[known]
    if len(y) < 2 * blocks or len(y) < 4 * len(design):
        return None
    scale = np.sqrt(np.einsum("ij,ij->i", design, design) / len(y))
    if not scale.all():
        return None
    design /= scale[:, None]
    problem = _Problem(design, y, resolution, *_scaled(priors or {}, scale), _starts(len(y), blocks))
    solved = problem.solve()
    if solved is None:
        return None
    coefficients, covariance, sigma = solved
    residuals = np.full(len(wanted), np.nan)
    residuals[known] = y - coefficients @ design
    return Fit(coefficients / scale, covariance / np.outer(scale, scale), residuals, sigma, blocks)


def propagated(function: Callable[[Array], Any], *parts: tuple[Array, Array], unit: str) -> Estimate:
    """A function of the coefficients of independent fits, given with their covariances."""
    at = np.concatenate([coefficients for coefficients, _ in parts])
    deviations = np.concatenate([np.sqrt(np.diag(covariance)) for _, covariance in parts])
    steps = np.where(deviations > 0, deviations, 1.0) * 1e-3
    slopes = np.array([(function(at + step) - function(at - step)) for step in np.diag(steps)]) / (2 * steps)
    variance, first = 0.0, 0
    for coefficients, covariance in parts:
        own = slopes[first : first + len(coefficients)]
        variance += float(own @ covariance @ own)
        first += len(coefficients)
    return estimate(float(function(at)), float(np.sqrt(variance)), unit)


def estimate(value: float, deviation: float, unit: str, blocks: int = BLOCKS) -> Estimate:
    """The estimate with its interval."""
    half = sides(blocks - 1) * deviation
    return Estimate(value, value - half, value + half, unit)


class _Problem(NamedTuple):
    """The columns of a regression, all of the size 1, and the priors' precisions and means."""

    columns: Array
    y: Array
    resolution: float
    precision: Array
    mean: Array
    starts: NDArray[np.int64]

    def solve(self) -> tuple[Array, Array, float] | None:
        """The coefficients, their covariance and sigma."""
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
            sigma = max(1.4826 * _median(np.abs(residuals)), 1e-9, self.resolution / 5)
            weights = _biweight(residuals / sigma)
        score = weights * residuals / sigma**2
        # How fast the scores change with the coefficients: less than the weights, since those change too.
        curve = weights * (_biweight_slope(residuals / sigma) / weights.mean() / sigma**2)
        if self.resolution:
            refined = self._refined(coefficients, max(sigma / 2, self.resolution / 4))
            if refined is None:
                return None
            coefficients, sigma, score, curve = refined
        return coefficients, self._covariance(curve, score), sigma

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

    def _covariance(self, curve: Array, score: Array) -> Array:
        # The normal equations of each block.
        ends = [*self.starts[1:], len(self.y)]
        curved = self.columns * curve
        gram = np.stack(
            [curved[:, a:b] @ self.columns[:, a:b].T for a, b in zip(self.starts, ends, strict=True)]
        )
        total = gram.sum(axis=0) + self.precision
        scores = np.add.reduceat(self.columns * score, self.starts, axis=1).T
        # How far the coefficients move without each block.
        moved = np.linalg.solve(total - gram, scores[..., None])[..., 0]
        moved -= moved.mean(axis=0)
        inverse = np.linalg.inv(total)
        spread: Array = moved.T @ moved * ((len(gram) - 1) / len(gram)) + inverse @ self.precision @ inverse
        return spread


def _scaled(priors: Mapping[int, Prior], scale: Array) -> tuple[Array, Array]:
    """The priors' precisions and means for columns of the size 1."""
    precision, mean = np.full(len(scale), 1e-12), np.zeros(len(scale))
    for index, prior in priors.items():
        precision[index] = 1 / (prior.deviation * scale[index]) ** 2
        mean[index] = prior.mean * scale[index]
    return np.diag(precision), mean


def _starts(rows: int, blocks: int) -> NDArray[np.int64]:
    return np.linspace(0, rows, blocks + 1)[:-1].astype(np.int64)


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
