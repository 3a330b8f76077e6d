"""Two covariances diagonalised at once: what every pairwise Gaussian rule starts from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.linalg import lapack

from track_fusion.linalg import Array, matvec, symmetrise, transpose


@dataclasses.dataclass(frozen=True)
class Pair:
    """P1 = T diag(first) T', P2 = T diag(second) T', first + second = 1, for a batch of pairs.

    The reference is P1 + P2, which is as sharp as the sharper track along no axis and as vague as the
    vaguer along every one, so that neither covariance is inverted. Diagonalising against one of
    the two instead goes wrong when each track is vague where the other is sharp.

    Attributes
    ----------
    basis : (B, n, n)        T
    inverse : (B, n, n)      T^-1
    first, second : (n, B)   axes first, so that sums over axes run along memory
    """

    basis: Array
    inverse: Array
    first: Array
    second: Array

    @classmethod
    def of(cls, p1: Array, p2: Array) -> Pair:
        """Diagonalise the pairs p1, p2, each (B, n, n), positive definite.

        Raises
        ------
        LinAlgError    P1 + P2 is not positive definite
        """
        lower = np.linalg.cholesky(p1 + p2)
        whiten = np.linalg.inv(lower)
        first, vectors = np.linalg.eigh(symmetrise(whiten @ p1 @ transpose(whiten)))
        first[(p1 == p2).all((-2, -1))] = 0.5
        first = np.ascontiguousarray(first.T)
        inverse = transpose(vectors) @ whiten
        second = 1.0 - first
        sharp = np.flatnonzero((first < SHARP).any(0) | (second < SHARP).any(0))
        if len(sharp):
            # Subtracting from one would lose the digits of a very sharp axis: measure it.
            first[:, sharp], second[:, sharp] = (_measured(inverse[sharp], p[sharp]) for p in (p1, p2))
        return cls(lower @ vectors, inverse, first, second)

    @property
    def contrast(self) -> Array:
        """Second - first, (n, B), and zero where rounding alone tells them apart."""
        difference = self.second - self.first
        return np.asarray(np.where(np.abs(difference) < EQUAL, 0.0, difference))

    def rebuild(self, diagonal: Array) -> Array:
        """Return T diag(d) T' for d of shape (n, B)."""
        return symmetrise((self.basis * diagonal.T[:, None, :]) @ transpose(self.basis))

    def coordinates(self, x: Array) -> Array:
        """Return T^-1 x with axes first: (B, n) -> (n, B)."""
        return np.ascontiguousarray(matvec(self.inverse, x).T)

    def from_coordinates(self, y: Array) -> Array:
        """Return T y: (n, B) -> (B, n)."""
        return matvec(self.basis, np.ascontiguousarray(y.T))


#: Below this share of P1 + P2, 1 - share has lost half its digits.
SHARP = 1e-8
#: Shares of P1 + P2 that differ by less are equal but for rounding, which must not decide on a weight.
EQUAL = 1e-12
#: Up to so many pairs, plain numbers (`SinglePair`) are faster than arrays (`Pair`).
FEW = 8


def _measured(inverse: Array, cov: Array) -> Array:
    """Diagonal of T^-1 P T^-T by itself, (n, B), positive."""
    diagonal = np.einsum("bij,bjk,bik->ib", inverse, cov, inverse, optimize=True)
    return np.asarray(np.maximum(diagonal, np.finfo(float).tiny))


@dataclasses.dataclass(frozen=True)
class SinglePair:
    """A `Pair` of one, its diagonals as plain numbers: a few calls to LAPACK instead of dozens to NumPy.

    Attributes
    ----------
    basis : (n, n)                           T
    inverse : (n, n)                         T^-1
    first, second : tuple of float (n,)      first + second = 1
    """

    basis: Array
    inverse: Array
    first: tuple[float, ...]
    second: tuple[float, ...]

    @classmethod
    def of(cls, p1: Array, p2: Array) -> SinglePair | None:
        """Diagonalise the pair p1, p2, each (n, n), positive definite; None where an axis is very sharp.

        Raises
        ------
        LinAlgError    P1 + P2 is not positive definite
        """
        lower, failed = lapack.dpotrf(p1 + p2, lower=1)
        if failed:
            raise np.linalg.LinAlgError("P1 + P2 of a pair of covariances is not positive definite")
        whiten = lapack.dtrtri(lower, lower=1)[0]
        shares, vectors, failed = lapack.dsyevd(whiten @ p1 @ whiten.T)
        if failed:
            raise np.linalg.LinAlgError("The eigenvalues of a pair of covariances did not converge")
        if (p1 == p2).all():
            shares[:] = 0.5
        first = tuple(shares.tolist())
        if first[0] < SHARP or first[-1] > 1.0 - SHARP:
            return None
        return cls(lower @ vectors, vectors.T @ whiten, first, tuple((1.0 - shares).tolist()))

    @property
    def contrast(self) -> list[float]:
        """Second - first, and zero where rounding alone tells them apart."""
        differences = [q - p for p, q in zip(self.first, self.second, strict=True)]
        return [d if abs(d) >= EQUAL else 0.0 for d in differences]

    def rebuild(self, diagonal: Sequence[float]) -> Array:
        """Return T diag(d) T'."""
        return symmetrise((self.basis * np.array(diagonal)) @ self.basis.T)
