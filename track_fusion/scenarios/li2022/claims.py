"""What section IV of Li 2022 says of its filters and rules in words, and what it leaves open, in both scenarios."""

from __future__ import annotations

from track_fusion.study.claim import Claim

#: The rows of a table by their rules, and covariance union's as it is about the mean at which its bound is least.
RULES = ("alone", "ic", "naive", "arithmetic_average", "covariance_intersection", "covariance_union")
AVERAGE, INTERSECTION, UNION = RULES[3:]
UNION_ANYWHERE = "covariance_union@optimal_mean"
POSITION, VELOCITY = "position_armse_m", "velocity_armse_mps"
CLAIMED, CREDIBILITY, WEIGHT = "position_claimed_m", "position_credibility_1", "sensor_1_weight_1"

#: What section IV leaves open in both scenarios.
ASSUMPTIONS = (
    "the fused posterior is fed back to both filters at every step",
    "the truth starts exactly at the initial mean, though the text draws it from the initial density: the printed "
    "rows come out only so; the filters start at the initial mean and covariance",
    "error: 2-norm, root-mean-square over runs at each step, averaged over the 100 steps",
    "covariance intersection by the trace, (18); @uniform is the geometric average at w = 1/2, (16)-(17)",
    "covariance union: no least upper bound exists, so the covariance of least determinant that covers both tracks is "
    "taken, about the arithmetic average (7), or @optimal_mean about the mean at which it is least; @max_trace is (8) "
    "with footnote 3. By least trace, whose axes have different units, a turn rate diverges in some runs. No reading "
    "gives the printed rows of both tables",
    "claimed over actual: trace of the position covariance over the squared position error, each averaged over runs "
    "and steps",
    "assumed: SIR resamples systematically after every step (the scheme is not given; @multinomial: by independent "
    "draws); estimates are made before it",
    "each SIR filter draws again from the fused density by itself (arithmetic average: from the union of the weighted "
    "particles, @gaussian: after conversion)",
    "assumed: particles turned into a Gaussian: 1e-9 of the initial variances is added",
)


def named(quantity: str, one: str, *rules: str) -> tuple[str, ...]:
    """Names of a figure of one filter under several rules."""
    return tuple(f"{one}-{rule}/{quantity}" for rule in rules)


def union_claims(one: str, source: str) -> tuple[Claim, ...]:
    """Covariance union against the other rules, in both readings of its mean."""
    rest = named(POSITION, one, "alone", "ic", AVERAGE, INTERSECTION)
    claims = []
    for union, about in ((UNION, "about the arithmetic average"), (UNION_ANYWHERE, "about the best mean")):
        name = f"{one.upper()} with covariance union {about}"
        own = named(POSITION, one, union)[0]
        claims += [
            Claim.greatest(f"{name} is worse than every row but naive fusion", source, own, rest),
            Claim.order(f"{name} is worse than the arithmetic average", source, *named(POSITION, one, AVERAGE), own),
            Claim(f"{name} is over-conservative: credibility above 1, the arithmetic average's and the intersection's",
                  source, named(CREDIBILITY, one, union, AVERAGE, INTERSECTION),
                  lambda first, *others: [first - 1.0, *(first - other for other in others)]),
        ]  # fmt: skip
    return tuple(claims)


def balance_claims(one: str, source: str) -> tuple[Claim, ...]:
    """Naive fusion is overconfident; what the average and the intersection claim lies between it and the union."""
    name = one.upper()
    return (
        Claim.below(
            f"{name} with naive fusion is inconsistent: it claims less than a quarter of its mean squared error",
            source, 0.25, *named(CREDIBILITY, one, "naive"),
        ),
        Claim.above(f"{name} with the arithmetic average or the intersection is conservative (credibility above .95)",
                    source, 0.95, *named(CREDIBILITY, one, AVERAGE, INTERSECTION)),
        Claim.order(f"{name}: chain (13) in what is claimed of the position, naive < sensor 1 < average < union",
                    "II-B, (13)", *named(CLAIMED, one, "naive", "alone", AVERAGE, UNION)),
        Claim.order(f"{name}: chain (19) in what is claimed of the position, naive < intersection < average",
                    "II-C, (19)", *named(CLAIMED, one, "naive", INTERSECTION, AVERAGE)),
    )  # fmt: skip


def weight_claims(one: str, source: str) -> tuple[Claim, ...]:
    """The average trusts the better sensor more, much the same in every run."""
    names = named(WEIGHT, one, AVERAGE), named("sensor_1_weight_sd_1", one, AVERAGE)
    return (
        Claim.above(f"{one.upper()}: the average gives sensor 1, the better one, more weight", source, 0.5, *names[0]),
        Claim.below(f"{one.upper()}: that weight varies little (standard deviation over runs below .05)", source,
                    0.05, *names[1]),
    )  # fmt: skip
