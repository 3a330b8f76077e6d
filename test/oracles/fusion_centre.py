"""A fusion centre by doc/fusion-centre.md: an oracle that shares no code with the package.

Plain loops, one track at a time; assignment by trying every one; fusion by plain matrix algebra, the weight of
covariance intersection in exact fractions. What can be varied is in `Settings`. States are x y vx vy.
"""

import itertools
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.stats import chi2

CONFIRMED, COASTED = 1, 2


@dataclass(frozen=True)
class Settings:
    """Parameters of the centre, named as the package names them."""

    sources: tuple[str, ...]
    max_scan_age_s: float
    gate_probability: float
    confirmation_threshold: tuple[int, int]
    deletion_threshold: tuple[int, int]
    max_coast_s: float
    process_noise: float  # standard deviation of an acceleration that is constant over a step, m/s^2
    memory: bool = False
    keep_probability: float = 0.0  # of the gate of linked tracks, if wider
    patience: int = 0
    merge_duplicates: str = "off"


def motion(dt, process_noise):
    """F and Q of nearly constant velocity with a piecewise constant acceleration, for the axes x y vx vy."""
    both_axes, s = np.eye(2), process_noise
    f = np.kron([[1, dt], [0, 1]], both_axes)
    return f, np.kron(s**2 * np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]]), both_axes)


def predict(mean, cov, from_ns, to_ns, process_noise):
    if from_ns == to_ns:
        return mean, cov
    f, q = motion((to_ns - from_ns) / 1e9, process_noise)
    return f @ mean, f @ cov @ f.T + q


# ---- the rules: members [(mean, cov)] to (mean, cov) -------------------------------------------------------------


def naive(members):
    cov = np.linalg.inv(sum(np.linalg.inv(p) for _, p in members))
    return cov @ sum(np.linalg.inv(p) @ m for m, p in members), cov


def arithmetic_average(members):
    mean = sum(m for m, _ in members) / len(members)
    return mean, sum(p + np.outer(m - mean, m - mean) for m, p in members) / len(members)


def determinant_polynomial(p, q):
    """Exact coefficients in w of det(p + w (q - p)): a sum over permutations (Leibniz)."""
    n, total = len(p), [Fraction(0)] * (len(p) + 1)
    for permutation in itertools.permutations(range(n)):
        inversions = sum(permutation[i] > permutation[j] for i in range(n) for j in range(i + 1, n))
        product = [Fraction((-1) ** inversions)]
        for i, j in enumerate(permutation):
            constant, slope = Fraction(p[i, j]), Fraction(q[i, j]) - Fraction(p[i, j])
            product = [a * constant + b * slope for a, b in zip([*product, 0], [0, *product], strict=True)]
        total = [a + b for a, b in zip(total, product, strict=True)]
    return total


def intersection_weight(p1, p2):
    """The w in [0, 1] that makes det of (w P1^-1 + (1-w) P2^-1)^-1 least, to 2^-70, in exact arithmetic.

    w P1^-1 + (1-w) P2^-1 = P1^-1 (w P2 + (1-w) P1) P2^-1, so det(P1 + w (P2 - P1)) is to be greatest. It is a
    polynomial whose logarithm is concave, so its slope changes sign at most once.
    """
    coefficients = determinant_polynomial(p1, p2)

    def slope(w):
        return sum(k * c * w ** (k - 1) for k, c in enumerate(coefficients) if k)

    low, high = Fraction(0), Fraction(1)
    if slope(low) <= 0 or slope(high) >= 0:
        return 0.0 if slope(low) <= 0 else 1.0
    for _ in range(70):
        middle = (low + high) / 2
        low, high = (middle, high) if slope(middle) > 0 else (low, middle)
    return float(low)


def covariance_intersection(members):
    (m1, p1), (m2, p2) = members
    w = intersection_weight(p1, p2)
    i1, i2 = w * np.linalg.inv(p1), (1 - w) * np.linalg.inv(p2)
    cov = np.linalg.inv(i1 + i2)
    return cov @ (i1 @ m1 + i2 @ m2), cov


# ---- the fusion centre, by doc/fusion-centre.md ------------------------------------------------------------------


def gate(probability):
    return float(chi2.ppf(probability, 4))


def apart(row, track):
    """Squared Mahalanobis distance, and the covariance of the difference."""
    s, r = row["cov"] + track["cov"], row["mean"] - track["mean"]
    return float(r @ np.linalg.inv(s) @ r), s


def associate(rows, tracks, settings, margins, source=None):
    """{index of row: index of track}, the candidates {(row, track): d2}; margins collects how close it was.

    A row whose track_id a track knows as that of its `source` may lie out to the gate that is kept, and costs as just
    inside the other.
    """
    gamma = gate(settings.gate_probability)
    keep = max(gamma, gate(settings.keep_probability))
    d2, log_det = {}, {}
    for i, row in enumerate(rows):
        for j, track in enumerate(tracks):
            distance, s = apart(row, track)
            limit = keep if (source, row["track_id"]) in track.get("links", ()) else gamma
            margins["gate"].append(abs(distance - limit))
            if distance <= limit:
                d2[i, j], log_det[i, j] = min(distance, gamma * (1 - 1e-9)), math.log(np.linalg.det(s))
    miss = {}  # of each row that has a candidate
    for i in {i for i, _ in d2}:
        component = {pair for pair in d2 if pair[0] == i}
        for _ in d2:  # often enough to reach all that is connected
            component = {p for p in d2 if any(p[0] == q[0] or p[1] == q[1] for q in component)}
        miss[i] = gamma + max(log_det[pair] for pair in component)
    options, choices = [], [[None, *(j for j in range(len(tracks)) if (i, j) in d2)] for i in range(len(rows))]
    for choice in itertools.product(*choices):
        taken = [j for j in choice if j is not None]
        if len(taken) == len(set(taken)):
            costs = [miss.get(i, 0.0) if j is None else d2[i, j] + log_det[i, j] for i, j in enumerate(choice)]
            options.append((sum(costs), choice))
    options.sort(key=lambda item: item[0])
    margins["assignment"] += [second[0] - options[0][0] for second in options[1:2]]
    return {i: j for i, j in enumerate(options[0][1]) if j is not None}, d2


def take_scans(scans, t, used, settings):
    """Steps 1 and 2. {source: rows predicted to t} of its newest scan, unless too old; the sources of new ones."""
    parts, new = {}, set()
    for source in settings.sources:
        past = [scan for scan in scans[source] if scan[0] <= t]
        if not past or (t - past[-1][0]) / 1e9 > settings.max_scan_age_s:
            continue
        stamp_ns, rows = past[-1]
        if (source, stamp_ns) not in used:
            new.add(source)
        elif settings.memory:
            continue
        used.add((source, stamp_ns))
        parts[source] = []
        for row in rows:
            mean, cov = predict(row["mean"], row["cov"], stamp_ns, t, settings.process_noise)
            parts[source].append({"track_id": row["track_id"], "mean": mean, "cov": cov, "stamp_ns": stamp_ns})
    return parts, new


def join(parts, new, central, next_id, settings, margins):
    """Steps 3 and 4: each source by itself with the central tracks; what is left, with groups of earlier sources."""
    older, candidates = list(central), []
    for source, rows in parts.items():
        pairs, d2 = associate(rows, older, settings, margins, source)
        candidates += [(source, rows[i]["track_id"], older[j]["track_id"]) for i, j in d2]
        for i, j in pairs.items():
            older[j]["members"][source] = rows[i]
        held = relink(source, rows, pairs, d2, older, source in new, settings)
        left = [row for i, row in enumerate(rows) if i not in pairs and i not in held and source in new]
        groups = central[len(older) :]
        pairs, _ = associate(left, groups, settings, margins)
        for i, row in enumerate(left):
            if i in pairs:
                groups[pairs[i]]["members"][source] = row
                groups[pairs[i]]["links"][source, row["track_id"]] = 0
                continue
            group = {"track_id": next_id, "mean": row["mean"], "cov": row["cov"], "members": {source: row}}
            group["links"] = {(source, row["track_id"]): 0}
            central.append(group | {"updates": {s: [] for s in settings.sources}, "confirmed": False})
            next_id += 1
    return candidates, next_id


def relink(source, rows, pairs, d2, tracks, is_new, settings):
    """The links of a source after its association, {(source, track_id): updates without part} in each central track.

    Returns the indices of the rows that are held out: linked, but unassigned, and their patience not over.
    """
    held, shares = set(), settings.merge_duplicates == "also_within_a_source"
    index = {row["track_id"]: i for i, row in enumerate(rows)}
    for j, track in enumerate(tracks):
        for own, track_id in [link for link in track["links"] if link[0] == source]:
            i = index.get(track_id)
            if i is not None and i in pairs:
                del track["links"][own, track_id]
            elif shares and (i, j) in d2:
                track["links"][own, track_id] = 0
                held.add(i)
            else:
                track["links"][own, track_id] += is_new
                if track["links"][own, track_id] > settings.patience:
                    del track["links"][own, track_id]
                elif i is not None:
                    held.add(i)
    for i, j in pairs.items():
        tracks[j]["links"][source, rows[i]["track_id"]] = 0
    for track in tracks:  # one that is there drives out those that are not
        own = {link for link in track["links"] if link[0] == source}
        gone = {link for link in own if link[1] not in index}
        if not shares and own - gone:
            track["links"] = {link: idle for link, idle in track["links"].items() if link not in gone}
    return held


def unite(central, settings, close, margins):
    """Step 8: what stays together and is told apart by no source becomes one. `close`: {pair of ids: steps}."""
    if settings.merge_duplicates == "off":
        return central
    gamma, pairs = gate(0.99), {}
    for older, younger in itertools.combinations(central, 2):
        lately = [{s for s, updates in track["updates"].items() if any(updates[-3:])} for track in (older, younger)]
        together = lately[0] & lately[1] and settings.merge_duplicates == "across_sources"
        if all(lately) and not together:
            distance = apart(older, younger)[0]
            margins["gate"].append(abs(distance - gamma))
            if distance <= gamma:
                pair = older["track_id"], younger["track_id"]
                pairs[pair] = close.get(pair, 0) + 1
    close.clear()
    close.update(pairs)
    by_id, moves = {track["track_id"]: track for track in central}, {}
    for pair, steps in sorted(pairs.items()):
        first, second = (by_id[k] for k in pair)
        lives, ends = (second, first) if second["confirmed"] and not first["confirmed"] else (first, second)
        if steps >= 3:
            moves.setdefault(ends["track_id"], lives["track_id"])
    for ends, lives in moves.items():
        if lives not in moves:
            by_id[lives]["links"] |= by_id[ends]["links"]
            central = [track for track in central if track["track_id"] != ends]
    return central


def fuse(track, rule, settings, *, existed):
    """Step 5. A group that begins in this step has no prediction of its own to take part."""
    members = [(m["mean"], m["cov"]) for m in (track["members"].get(s) for s in settings.sources) if m]
    if members:
        if settings.memory and existed:
            members.insert(0, (track["mean"], track["cov"]))
        track["mean"], track["cov"] = rule(members) if len(members) > 1 else members[0]
        track["last_member_ns"] = max(m["stamp_ns"] for m in track["members"].values())


def stays(track, new, t, settings):
    """Steps 6 and 7: count, confirm; whether the track is kept."""
    for source in new:
        track["updates"][source].append(source in track["members"])
    m, n = settings.confirmation_threshold
    track["confirmed"] |= any(sum(u[-n:]) >= m for u in track["updates"].values())
    p, q = settings.deletion_threshold
    worn_out = all(u[-q:].count(False) >= p for u in track["updates"].values() if any(u))
    overdue = (t - track["last_member_ns"]) / 1e9 > settings.max_coast_s
    return bool(track["members"]) or not (worn_out or overdue)


def published(track, sources):
    """Step 9."""
    bits = sum(2**k for k, source in enumerate(sources) if source in track["members"])
    row = {"track_id": track["track_id"], "source": bits, "status": CONFIRMED + (0 if bits else COASTED)}
    return row | {"mean": track["mean"].tolist(), "cov": track["cov"].tolist()}


def run_centre(scans, rule, settings):
    """The expected steps, a log of them for checks, and how close its decisions were.

    scans: {source: [(stamp_ns, rows)]}, a row with track_id, mean and cov; rule: one of the above.
    """
    central, next_id, last_ns = [], 1, None
    used, steps, log, margins = set(), [], [], {"gate": [], "assignment": []}
    close = {}
    for t in sorted({stamp_ns for source in settings.sources for stamp_ns, _ in scans[source]}):
        parts, new = take_scans(scans, t, used, settings)
        for track in central:
            track["mean"], track["cov"] = predict(track["mean"], track["cov"], last_ns, t, settings.process_noise)
            track["members"] = {}
        count = len(central)
        candidates, next_id = join(parts, new, central, next_id, settings, margins)
        for k, track in enumerate(central):
            fuse(track, rule, settings, existed=k < count)
        central = [track for track in central if stays(track, new, t, settings)]
        central = unite(central, settings, close, margins)
        tracks = [published(track, settings.sources) for track in central if track["confirmed"]]
        steps.append({"stamp_ns": t, "tracks": tracks})
        members = {(s, m["track_id"]): track["track_id"] for track in central for s, m in track["members"].items()}
        log.append({"members": members, "candidates": candidates})
        last_ns = t
    return steps, log, margins
