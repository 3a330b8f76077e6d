"""Peers: exact on trees with channel filters, double counting without, conservative rules anywhere, mixtures too."""

import doctest

import numpy as np
import pytest
from oracles.kalman import predict, update

import track_fusion.peers
from track_fusion.densities.mixture.algebra import LogMixture, product
from track_fusion.densities.mixture.mixture import Mixture, log_pdf, stacked
from track_fusion.densities.on_grid import grid, kl_on_grid
from track_fusion.peers import Peer, Schedule, by_rule, communicate, gaussian, on_tree, ring, star, sweep
from track_fusion.rules import RULES, SourceTracks
from track_fusion.rules.mixture_exact import MixtureExactParams
from track_fusion.rules.mixture_wep import MixtureWepParams

RUNS, N = 400, 2
PRIOR_COV = np.array([[4.0, 1.0], [1.0, 2.0]])
H = {name: np.random.default_rng(k).standard_normal((1, N)) for k, name in enumerate("abcde")}
R = np.array([[0.5]])
TREE = [("a", "c"), ("b", "c"), ("c", "d"), ("e", "d")]
EXACT = by_rule(RULES["mixture_exact"])
NAIVE = by_rule(RULES["naive"])


def drawn(rounds=3, seed=1):
    """The truth (R, n), and what every peer sees in each of some rounds."""
    rng = np.random.default_rng(seed)
    truth = rng.standard_normal((RUNS, N)) @ np.linalg.cholesky(PRIOR_COV).T
    seen = [
        {name: truth @ matrix.T + np.sqrt(R[0, 0]) * rng.standard_normal((RUNS, 1)) for name, matrix in H.items()}
        for _ in range(rounds)
    ]
    return truth, seen


def prior():
    return gaussian(np.zeros((RUNS, N)), PRIOR_COV)


def see(z, name):
    def change(density):
        mean, cov, _ = update(density.mean[..., 0, :], density.cov[..., 0, :, :], z, H[name], R)
        return gaussian(mean, cov)

    return change


def centralised(*seen):
    """Posterior of all measurements by least squares in one go: no filter, no fusion."""
    info, pull = np.linalg.inv(PRIOR_COV), np.zeros((RUNS, N))
    for zs in seen:
        for name, z in zs.items():
            info = info + H[name].T @ H[name] / R
            pull = pull + z @ H[name] / R[0, 0]
    return pull @ np.linalg.inv(info), np.linalg.inv(info)


def run(peers, seen, rounds, fuse):
    for zs in seen:
        peers = {name: peer.updated(see(zs[name], name)) for name, peer in peers.items()}
        for sent in rounds:
            peers = communicate(peers, sent, fuse)
    return peers


def test_the_docstrings_example_runs():
    assert doctest.testmod(track_fusion.peers).attempted > 5
    assert doctest.testmod(track_fusion.peers).failed == 0


def test_with_channel_filters_every_peer_of_a_tree_has_the_centralised_estimate():
    truth, seen = drawn()
    peers = on_tree(dict.fromkeys(H, prior()), prior(), TREE)
    peers = run(peers, seen, sweep(TREE, "d"), EXACT)
    mean, cov = centralised(*seen)
    for peer in peers.values():
        np.testing.assert_allclose(peer.moments[0], mean, atol=1e-10)
        np.testing.assert_allclose(peer.moments[1], np.broadcast_to(cov, (RUNS, N, N)), atol=1e-12)


def test_both_ends_talk_at_once_and_news_travels_one_link_a_round():
    """Simultaneous exchange over all links: four rounds are the tree's diameter, more change nothing."""
    truth, seen = drawn(1)
    both = TREE + [(b, a) for a, b in TREE]
    peers = run(on_tree(dict.fromkeys(H, prior()), prior(), TREE), seen, [both] * 2, EXACT)
    mean, cov = centralised({name: seen[0][name] for name in "abcd"})  # what two links carry to a
    np.testing.assert_allclose(peers["a"].moments[0], mean, atol=1e-10)
    for _ in range(4):
        peers = communicate(peers, both, EXACT)
    mean, cov = centralised(*seen)
    for peer in peers.values():
        np.testing.assert_allclose(peer.moments[0], mean, atol=1e-10)
        np.testing.assert_allclose(peer.moments[1][0], cov, atol=1e-12)
    for a, b in TREE:
        at_a, at_b = peers[a].channels[b].common, peers[b].channels[a].common
        np.testing.assert_array_equal(at_a.mean, at_b.mean)
        np.testing.assert_array_equal(at_a.cov, at_b.cov)


def test_two_peers_that_talk_at_every_step_are_exact_under_process_noise():
    f, q = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.3, 0.1], [0.1, 0.5]])
    _, seen = drawn(4)

    def move(density):
        return gaussian(*predict(density.mean[..., 0, :], density.cov[..., 0, :, :], f, q))

    peers = on_tree({"a": prior(), "b": prior()}, prior(), [("a", "b")])
    mean, cov = np.zeros((RUNS, N)), np.broadcast_to(PRIOR_COV, (RUNS, N, N))
    for zs in seen:
        peers = {name: peer.moved(move).updated(see(zs[name], name)) for name, peer in peers.items()}
        peers = communicate(peers, [("a", "b"), ("b", "a")], EXACT)
        mean, cov = predict(mean, cov, f, q)
        for name in "ab":
            mean, cov, _ = update(mean, cov, zs[name], H[name], R)
    for peer in peers.values():
        np.testing.assert_allclose(peer.moments[0], mean, atol=1e-9)
        np.testing.assert_allclose(peer.moments[1], cov, atol=1e-10)


def test_without_channels_naive_fusion_counts_the_prior_and_old_news_again():
    """Data incest: three rounds of naive fusion claim a small part of their mean squared error; exact fusion all."""
    truth, seen = drawn()
    naive = run({name: Peer(prior()) for name in H}, seen, sweep(TREE, "d"), NAIVE)
    exact = run(on_tree(dict.fromkeys(H, prior()), prior(), TREE), seen, sweep(TREE, "d"), EXACT)

    def error_over_claim(peer):
        mean, cov = peer.moments
        return float(((mean - truth) ** 2).sum(1).mean() / np.trace(cov[0]))

    assert error_over_claim(exact["d"]) == pytest.approx(1.0, abs=3 * np.sqrt(2 / RUNS))
    for peer in naive.values():
        assert error_over_claim(peer) > 100 * (1 - 3 * np.sqrt(2 / RUNS))
    # Two peers, one prior, no measurement: the prior is claimed twice.
    twice = communicate({"a": Peer(prior()), "b": Peer(prior())}, [("a", "b")], NAIVE)["b"].moments[1][0]
    np.testing.assert_allclose(twice, PRIOR_COV / 2, rtol=1e-12)


def test_intersection_on_a_loop_is_consistent_and_never_beats_the_centre():
    truth, seen = drawn()
    peers = run(
        {name: Peer(prior()) for name in H}, seen, [ring("abcde")] * 6, by_rule(RULES["covariance_intersection"])
    )
    _, best = centralised(*seen)
    for peer in peers.values():
        mean, cov = peer.moments
        assert np.linalg.eigvalsh(cov[0] - best).min() > 0  # claims less
        error = (mean - truth).T @ (mean - truth) / RUNS
        assert np.trace(error) > np.trace(best)  # and is worse
        assert np.trace(error) < np.trace(cov[0]) * (1 + 3 * np.sqrt(2 / RUNS))


def test_everyone_sends_what_it_held_before_the_round():
    mean = np.array([[0.0], [3.0], [9.0]])
    peers = {name: Peer(gaussian(m, np.eye(1))) for name, m in zip("abc", mean, strict=True)}
    heard = communicate(peers, ring("abc"), NAIVE)
    assert [float(heard[n].moments[0][0]) for n in "abc"] == pytest.approx([4.5, 1.5, 6.0])
    staged = communicate(communicate(peers, [("a", "b")], NAIVE), [("b", "c")], NAIVE)
    assert float(staged["c"].moments[0][0]) == pytest.approx((0 + 3 + 9) / 3)


def test_a_receiver_fuses_in_the_order_of_the_round():
    names = "abc"
    rng = np.random.default_rng(3)
    peers = {n: Peer(gaussian(rng.standard_normal(2), np.diag(rng.uniform(0.5, 4.0, 2)))) for n in names}
    rule = RULES["inverse_covariance_intersection"]
    fuse = by_rule(rule)
    found = communicate(peers, [("b", "a"), ("c", "a")], fuse)["a"].moments
    first = rule.fuse(SourceTracks.of(stacked(peers["a"].density, peers["b"].density)), rule.params())
    both = SourceTracks.of(stacked(gaussian(first.mean, first.cov), peers["c"].density))
    second = rule.fuse(both, rule.params())
    np.testing.assert_allclose(found[0], second.mean, rtol=1e-12)
    np.testing.assert_allclose(found[1], second.cov, rtol=1e-12)


def test_mixtures_on_a_star_agree_with_the_centralised_product():
    """Likelihoods that are Gaussian products: the centralised posterior is a mixture in closed form."""
    prior = Mixture(np.array([0.5, 0.3, 0.2]), np.array([[-4.0, 0.0], [3.0, 3.0], [1.0, -4.0]]),
                    np.stack([np.eye(2) * s for s in (4.0, 5.0, 3.0)]))  # fmt: skip
    likelihoods = {
        "a": Mixture(np.ones(1), np.array([[0.0, 2.0]]), np.diag([3.0, 6.0])[None]),
        "b": Mixture(np.array([0.7, 0.3]), np.array([[-2.0, 0.0], [3.0, 1.0]]), np.stack([np.eye(2) * 2.0] * 2)),
        "c": Mixture(np.ones(1), np.array([[1.0, 0.0]]), np.diag([6.0, 4.0])[None]),
    }
    whole, local = LogMixture.of(prior), {}
    for name, likelihood in likelihoods.items():
        local[name] = product(LogMixture.of(prior), LogMixture.of(likelihood)).normalised
        whole = product(whole, LogMixture.of(likelihood))
    links = star("b", "ac")
    fuse = by_rule(RULES["mixture_exact"], MixtureExactParams(mixand_samples=2000))
    peers = on_tree(local, prior, links)
    for sent in sweep(links, "b"):
        peers = communicate(peers, sent, fuse)
    points = grid(np.full(2, -12.0), np.full(2, 12.0), 120)
    for peer in peers.values():
        apart = kl_on_grid(log_pdf(whole.normalised, points), log_pdf(peer.density, points))
        assert apart < 2e-3
    # A leaf that hears back from the hub takes its density: what it sent itself is all common.
    hub, leaf = (log_pdf(peers[name].density, points) for name in "ba")
    np.testing.assert_allclose(leaf, hub, rtol=1e-9)
    naive_bayes = by_rule(RULES["mixture_wep"], MixtureWepParams(method="naive_bayes"))
    naive = communicate({n: Peer(d) for n, d in local.items()}, sweep(links, "b")[0], naive_bayes)["b"]
    assert kl_on_grid(log_pdf(whole.normalised, points), log_pdf(naive.density, points)) > 0.05


def test_schedules_and_topologies():
    schedule = Schedule((ring("123"),), period=60)
    assert [step for step in range(1, 200) if schedule.at(step)] == [60, 120, 180]
    assert schedule.at(60) == ([("1", "2"), ("2", "3"), ("3", "1")],)
    assert sweep(star("3", "1245"), "3") == (
        [("1", "3"), ("2", "3"), ("4", "3"), ("5", "3")],
        [("3", "1"), ("3", "2"), ("3", "4"), ("3", "5")],
    )
    assert sweep(TREE, "a")[0] == [("e", "d")]


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: on_tree({"a": 0, "b": 0, "c": 0}, 0, [("a", "b"), ("b", "c"), ("c", "a")]),
         "Exact fusion by channel filters needs a tree. Got a loop closed by ('c', 'a')."),
        (lambda: on_tree({"a": 0}, 0, [("a", "x")]), "An edge must name two peers out of a. Got 'x'."),
        (lambda: communicate({"a": Peer(0)}, [("a", "a")], NAIVE), "A peer must not send to itself. Got ('a', 'a')."),
        (lambda: communicate({"a": Peer(0), "b": Peer(0)}, [("a", "b"), ("a", "b")], NAIVE),
         "An edge must stand in a round once. Got ('a', 'b') twice."),
        (lambda: communicate(on_tree({"a": 0, "b": 0}, 0, []), [("a", "b")], EXACT),
         "The peer 'a' has no channel to 'b': the tree lacks this link."),
        (lambda: communicate({"a": Peer(prior()), "b": Peer(prior())}, [("a", "b")], EXACT),
         "The rule 'mixture_exact' needs the common information of a channel filter."),
        (lambda: communicate(on_tree({"a": prior(), "b": prior()}, prior(), [("a", "b")]), [("a", "b")], NAIVE),
         "The rule 'naive' makes no use of the common information of a channel filter."),
        (lambda: by_rule(RULES["split_covariance_intersection"]),
         "The rule 'split_covariance_intersection' needs 'independent_cov', which peers do not exchange."),
        (lambda: sweep([("a", "b"), ("c", "d")], "a"),
         "The links must join all peers. Got none from 'a' to 'c'."),
    ],
)  # fmt: skip
def test_what_is_refused(call, text):
    with pytest.raises(ValueError) as error:
        call()
    assert str(error.value) == text
