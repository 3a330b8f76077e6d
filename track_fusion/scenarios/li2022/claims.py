"""What section IV of Li 2022 says of its filters and rules in words, and what it leaves open, in both scenarios."""

from __future__ import annotations

from track_fusion.study.claim import Claim, ascending

#: The rows of a table by their rules, and covariance union's as it is about the mean at which its bound is least.
RULES = ("alone", "ic", "naive", "arithmetic_average", "covariance_intersection", "covariance_union")
AVERAGE, INTERSECTION, UNION = RULES[3:]
UNION_ANYWHERE = "covariance_union@optimal_mean"
POSITION, VELOCITY = "position_armse_m", "velocity_armse_mps"
CLAIMED, CREDIBILITY, WEIGHT = "position_claimed_m", "position_credibility_1", "sensor_1_weight_1"
#: Two rows are close to each other if all of a table that the text calls so are: in Table I SIR-CI is 6 % above SIR-AA,
#: in Table II 7 % above CKF-IC.
CLOSE_1, CLOSE_2 = 0.06, 0.08
#: Naive fusion has lost the target if it errs so many times as much as every other row of its filter.
LOST = 3.0

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


def linear_claims() -> tuple[Claim, ...]:
    """What section IV-A says of Table I."""
    others = ("alone", "ic", AVERAGE, INTERSECTION, UNION)
    claims = [
        Claim.least("KF with both sensors' measurements (IC) is the best row of all", "IV-A",
                    f"kf-ic/{POSITION}",
                    [n for one in ("kf", "sir") for n in named(POSITION, one, *RULES) if n != f"kf-ic/{POSITION}"]),
        Claim.each("the Kalman filter does better than the particle filter with every rule and alone", "IV-A",
                   named(POSITION, "kf", *RULES), named(POSITION, "sir", *RULES), ascending),
        Claim.near("KF-IC is Bayes-optimal: what it claims is its mean squared error (credibility within 5 % of 1)",
                   "IV", 1.0, 0.05, *named(CREDIBILITY, "kf", "ic")),
    ]  # fmt: skip
    for one in ("kf", "sir"):
        name = one.upper()
        ic, average, intersection = named(POSITION, one, "ic", AVERAGE, INTERSECTION)
        claims += [
            Claim.greatest(f"{name} with naive fusion is the worst row, worse than sensor 1 alone", "IV-A",
                           f"{one}-naive/{POSITION}", named(POSITION, one, *others)),
            Claim.close(
                f"{name}: average and intersection are similar (within 6 %)", "IV-A", CLOSE_1, average, intersection
            ),
            Claim.close(f"{name}: the average is close to IC (within 6 %)", "IV-A", CLOSE_1, ic, average),
            Claim.close(f"{name}: the intersection is close to IC (within 6 %)", "IV-A", CLOSE_1, ic, intersection),
            Claim.order(f"{name}: the average beats the intersection in position", "Table I", average, intersection),
            Claim.order(f"{name}: the intersection beats the average in velocity", "Table I",
                        *named(VELOCITY, one, INTERSECTION, AVERAGE)),
            *union_claims(one, "IV-A"),
            *balance_claims(one, "IV-A"),
        ]  # fmt: skip
    return (*claims, *weight_claims("kf", "IV-A, Fig. 6"))


def nonlinear_claims() -> tuple[Claim, ...]:
    """What section IV-B says of Table II."""
    first, last = named("sensor_1_weight_first_1", "ckf", AVERAGE), named("sensor_1_weight_last_1", "ckf", AVERAGE)
    but_ic = ("alone", "naive", AVERAGE, INTERSECTION, UNION)
    claims = [
        Claim.order(
            "SIR with both sensors' measurements (IC) is worse than CKF-IC, and even than SIR with covariance union",
            "IV-B", f"ckf-ic/{POSITION}", f"sir-{UNION}/{POSITION}", f"sir-ic/{POSITION}",
        ),
        Claim.each("the particle filter does better than the cubature filter with every rule and alone, except IC",
                   "IV-B", named(POSITION, "sir", *but_ic), named(POSITION, "ckf", *but_ic), ascending),
        Claim.order("the weight on sensor 1 falls from the first step to the last", "IV-B, Fig. 11", *last, *first),
        *weight_claims("ckf", "IV-B, Fig. 11"),
    ]  # fmt: skip
    for rule in (AVERAGE, INTERSECTION):
        names = [f"{one}-{rule}/{POSITION}" for one in ("ckf", "sir")]
        claims.append(
            Claim.close(f"particles do not degenerate under {rule}: SIR is within 8 % of CKF", "IV-B", CLOSE_2, *names)
        )  # fmt: skip
    for one in ("ckf", "sir"):
        name, naive = one.upper(), f"{one}-naive/{POSITION}"
        best = named(POSITION, one, AVERAGE, INTERSECTION)
        claims += [
            Claim.greatest(f"{name} with naive fusion loses the target: three times the error of every other row",
                           "IV-B, Fig. 7", naive, named(POSITION, one, "alone", "ic", AVERAGE, INTERSECTION, UNION),
                           LOST),
            Claim.order(
                f"{name} with covariance union is worse than with naive fusion (as the text has it, against Table II)",
                "IV-B", naive, f"{one}-{UNION}/{POSITION}",
            ),
            Claim(f"{name}: average and intersection are better than naive fusion and union", "IV-B",
                  (*best, naive, f"{one}-{UNION}/{POSITION}"),
                  lambda *errors: [worse - better for better in errors[:2] for worse in errors[2:]]),
            Claim.close(
                f"{name}: the average is close to CKF-IC (within 8 %)", "IV-B", CLOSE_2, f"ckf-ic/{POSITION}", best[0]
            ),
            Claim.close(f"{name}: the intersection is close to CKF-IC (within 8 %)", "IV-B",
                        CLOSE_2, f"ckf-ic/{POSITION}", best[1]),
            *union_claims(one, "IV-B"),
            *balance_claims(one, "IV-B"),
        ]  # fmt: skip
    return tuple(claims)
