"""What central tracks are called: a number on the wire, and a UUID that no other track ever has."""

from __future__ import annotations

import time
import uuid
from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from track_fusion.centre.config import IdentityParams
from track_fusion.tracks import UUID_BYTES

#: The namespace of the namespaces that `identity_namespace` names.
_NAMED = uuid.uuid5(uuid.NAMESPACE_DNS, "track_fusion.identity_namespace")
_IDS = 2**32  # the wire has 32 bits for a number
#: Numbers begin with the milliseconds of the start, modulo this: 25 days. Half of what the wire holds, so that they
#: ascend for as many births.
_BEGINNINGS = 2**31
_MS_NS = 1_000_000


class Identities(NamedTuple):
    """What has been given so far.

    Attributes
    ----------
    namespace : UUID    of the UUIDs of this centre
    births : int        number of the next newborn; on the wire modulo 2^32
    """

    namespace: uuid.UUID
    births: int

    @classmethod
    def begun(cls, params: IdentityParams) -> Identities:
        """Begin at number 1 of the namespace that the parameters name; without one, apart from every other start.

        Two starts within 25 days never give the same number, as long as fewer than 1000 tracks a second are born.
        """
        if params.identity_namespace:
            return cls(uuid.uuid5(_NAMED, params.identity_namespace), 1)
        start_ns = time.time_ns()  # wall time, since simulated time begins again with every start
        return cls(uuid.uuid5(uuid.uuid4(), str(start_ns)), start_ns // _MS_NS % _BEGINNINGS)

    def given(self, count: int) -> tuple[NDArray[np.int64], NDArray[np.uint8], Identities]:
        """Name newborn tracks.

        Returns
        -------
        (count,)       numbers, as the wire has them
        (count, 16)    UUIDs: version 5, of the namespace and the number
        Identities     what has been given then
        """
        numbers = range(self.births, self.births + count)
        ids = np.fromiter(numbers, np.int64, count) % _IDS
        return ids, self.uuids(numbers), self._replace(births=self.births + count)

    def uuids(self, numbers: Collection[int]) -> NDArray[np.uint8]:
        """Return the UUIDs of births, (N, 16): version 5, of the namespace and the number."""
        names = b"".join(_uuid(self.namespace, number) for number in numbers)
        return np.frombuffer(names, np.uint8).reshape(len(numbers), UUID_BYTES)


@lru_cache(maxsize=4096)
def _uuid(namespace: uuid.UUID, number: int) -> bytes:
    return uuid.uuid5(namespace, str(number)).bytes
