"""MOTA, IDF1 and HOTA by plain loops over the definitions of their papers: it shares no code with the package.

A scene is ({target: position}, {track: position}), positions as (x, y).
"""

import itertools
import math

ALPHAS = [k / 20 for k in range(1, 20)]


def best_pairs(rows, cols, gain):
    """The one-to-one pairs of most total gain, pairs of no gain left out, by trying all."""
    if len(rows) > len(cols):
        return [(a, b) for b, a in best_pairs(cols, rows, lambda b, a: gain(a, b))]
    ways = ([(a, b) for a, b in zip(rows, way, strict=True)] for way in itertools.permutations(cols, len(rows)))
    best = max(ways, key=lambda way: sum(gain(a, b) for a, b in way), default=[])
    return [(a, b) for a, b in best if gain(a, b) > 0]


def clear(scenes, c):
    """MOTA, MOTP, switches, completeness: section 3 of Bernardin and Stiefelhagen, pairs kept while they may be."""
    before, last, switches, pairs, total, targets, tracks = {}, {}, 0, 0, 0.0, 0, 0
    for truth, seen in scenes:
        kept = {t: k for t, k in before.items() if t in truth and k in seen and math.dist(truth[t], seen[k]) < c}
        free_t, free_k = [t for t in truth if t not in kept], [k for k in seen if k not in kept.values()]
        made = best_pairs(free_t, free_k, lambda t, k, a=truth, b=seen: max(c - math.dist(a[t], b[k]), 0))
        before = kept | dict(made)
        switches += sum(last.get(t, k) != k for t, k in before.items())
        last |= before
        pairs += len(before)
        total += sum(math.dist(truth[t], seen[k]) for t, k in before.items())
        targets, tracks = targets + len(truth), tracks + len(seen)
    missed, false = targets - pairs, tracks - pairs
    return {
        "mota": 1 - (missed + false + switches) / targets, "motp_m": total / pairs if pairs else None,
        "id_switches": switches, "completeness": pairs / targets,
    }  # fmt: skip


def idf1(scenes, c):
    """Twice the times that one-to-one identities can explain, of all; section 3 of Ristani et al."""
    near = {}
    for truth, seen in scenes:
        for t, k in itertools.product(truth, seen):
            near[t, k] = near.get((t, k), 0) + (math.dist(truth[t], seen[k]) < c)
    rows, cols = sorted({t for t, _ in near}), sorted({k for _, k in near})
    explained = sum(near[pair] for pair in best_pairs(rows, cols, lambda t, k: near.get((t, k), 0)))
    return 2 * explained / sum(len(truth) + len(seen) for truth, seen in scenes)


def hota(scenes, c):
    """HOTA, DetA, AssA: equations 14 to 22 of Luiten et al., matching as in its section 5.1."""
    alike = [
        {(t, k): max(1 - math.dist(truth[t], seen[k]) / c, 0) for t in truth for k in seen} for truth, seen in scenes
    ]
    times_t, times_k, together = {}, {}, {}
    for (truth, seen), s in zip(scenes, alike, strict=True):
        for t in truth:
            times_t[t] = times_t.get(t, 0) + 1
        for k in seen:
            times_k[k] = times_k.get(k, 0) + 1
        for t, k in s:
            if s[t, k] > 0:
                either = sum(s[t, x] for x in seen) + sum(s[x, k] for x in truth) - s[t, k]
                together[t, k] = together.get((t, k), 0) + s[t, k] / either

    def aligned(t, k):
        both = together.get((t, k), 0)
        return both / (times_t[t] + times_k[k] - both)

    chosen = [
        best_pairs(list(truth), list(seen), lambda t, k, s=s: aligned(t, k) * s[t, k])
        for (truth, seen), s in zip(scenes, alike, strict=True)
    ]
    sums = [0.0, 0.0, 0.0]
    for alpha in ALPHAS:
        matched = {}
        for pairs, s in zip(chosen, alike, strict=True):
            for pair in pairs:
                if s[pair] >= alpha - 1e-15:
                    matched[pair] = matched.get(pair, 0) + 1
        tp = sum(matched.values())
        detection = tp / max(sum(times_t.values()) + sum(times_k.values()) - tp, 1)
        association = sum(n * n / (times_t[t] + times_k[k] - n) for (t, k), n in matched.items()) / max(tp, 1)
        for at, value in enumerate((math.sqrt(detection * association), detection, association)):
            sums[at] += value / len(ALPHAS)
    return dict(zip(("hota", "deta", "assa"), sums, strict=True))
