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
        first = np.ascontiguousarray(first.T)
        inverse = transpose(vectors) @ whiten
        second = 1.0 - first
        if first.size and (first.min() < SHARP or first.max() > 1.0 - SHARP):
            # Subtracting from one would lose the digits of a very sharp axis: measure it.
            first, second = _measured(inverse, p1), _measured(inverse, p2)
        return cls(lower @ vectors, inverse, first, second)

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
        total = p1 + p2
        shares, vectors, failed = lapack.dsygv(p1, total)
        if failed:
            raise np.linalg.LinAlgError("P1 + P2 of a pair of covariances is not positive definite")
        first = tuple(shares.tolist())
        if first[0] < SHARP or first[-1] > 1.0 - SHARP:
            return None
        return cls(total @ vectors, vectors.T, first, tuple((1.0 - shares).tolist()))

    def rebuild(self, diagonal: Sequence[float]) -> Array:
        """Return T diag(d) T'."""
        return symmetrise((self.basis * np.array(diagonal)) @ self.basis.T)
