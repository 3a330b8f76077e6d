"""Van Loan's discretisation of a linear stochastic differential equation."""

from __future__ import annotations

import numpy as np

from track_fusion.linalg import Array, symmetrise, transpose


def van_loan(drift: Array, diffusion: Array, dt: float) -> tuple[Array, Array]:
    """Return F = exp(A dt) and Q = integral over [0, dt] of exp(A s) L exp(A s)' ds for dx = A x dt + noise.

    Parameters
    ----------
    drift : (..., n, n)        A
    diffusion : (..., n, n)    L, power spectral density of the noise
    dt : float                 seconds, >= 0

    Returns
    -------
    F (..., n, n), Q (..., n, n)

    Raises
    ------
    ValueError    dt is negative

    Notes         Q comes out of the exponential of [[-A, L], [0, A']] dt, which overflows where -A dt does: for
                  strongly damped models take several short intervals.
    References    C. Van Loan, Computing integrals involving the matrix exponential, 1978; Ahmed 5.4.1.
    """
    from scipy.linalg import expm

    if dt < 0:
        raise ValueError(f"The 'dt' of a prediction must be >= 0 s. Got {dt:g}.")
    drift, diffusion = np.broadcast_arrays(drift, diffusion)
    n = drift.shape[-1]
    block = np.zeros((*drift.shape[:-2], 2 * n, 2 * n))
    block[..., :n, :n], block[..., :n, n:], block[..., n:, n:] = -drift, diffusion, transpose(drift)
    power = np.asarray(expm(block * dt))
    transition = transpose(power[..., n:, n:])
    return transition, symmetrise(transition @ power[..., :n, n:])
