"""track-fusion reproduce: the figures, their verdicts, and that a seed decides them."""

from __future__ import annotations

import base64
import os
import pty
import re
import subprocess
import sys
import threading
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import pytest
from cli.runner import DEADLINE_S, ROOT, refusal, run, strict_json

VERDICTS = {"agrees", "contradicts", "undecided", "by construction", "not given"}
NAME = re.compile(r"^[a-z0-9]+-[a-z0-9_]+(@[a-z0-9_]+)?/[a-z0-9_]+_[a-z0-9]+$")


#: A line a scenario that is done, where stderr is no terminal.
TOLD = re.compile(r"^\S+: \d+ runs?, \d+\.\d s of one processor$")


#: A scenario that takes no time; its file notes what it is asked for.
COIN = """
from pathlib import Path
import numpy as np
from track_fusion.metrics.accuracy import Estimate
from track_fusion.study.chart import Chart, Series
from track_fusion.study.claim import Claim
from track_fusion.study.scenario import Scenario

def simulate(runs, seed, progress, only=""):
    Path(__file__).with_suffix(f".asked-{seed}-{runs.start}-{runs.stop}").touch()
    return {"heads": np.arange(runs.start, runs.stop) + seed}

def figures(outcomes):
    runs = len(outcomes["heads"])
    swing = np.where(np.arange(runs) < runs / 2, 1.0, -1.0) * np.sqrt((runs - 1) / runs)  # spread 1, mean 0 if even
    return {
        "kf-alone/error_m": Estimate.mean(1.0 + 0.01 * np.sqrt(runs) * swing),
        "kf-ic/error_m": Estimate.mean(9.0 - 0.01 * np.sqrt(runs) * swing),
        "kf-alone/luck_1": Estimate.mean(0.3 + swing),
        "kf-naive/error_m": Estimate(2.0, float("nan"), runs),
        "kf-sum/heads_1": Estimate.exact(outcomes["heads"].sum()),
    }

def charts(outcomes):
    return [Chart("Heads & <tails>", "run", "1", (Series("heads", np.arange(3.0), np.array([1.0, np.nan, 2.0])),))]

SCENARIO = Scenario(
    key="NAME", title="A fair <coin>", paper="Nobody", shows="nothing",
    simulate=simulate, figures=figures, charts=charts,
    published={"kf-alone/error_m": 1.01, "kf-ic/error_m": 0.5}, published_runs=10, default_runs=RUNS,
    publication_runs=900, assumptions=("it is fair",), claims=(
        Claim.below("heads & tails are rare", "Fig. 1", 0.0, "kf-sum/heads_1"),
        Claim.order("all is better than one", "Fig. 2", "kf-alone/error_m", "kf-ic/error_m"),
        Claim.order("naive lies between", "Fig. 2", "kf-alone/error_m", "kf-naive/error_m", "kf-ic/error_m"),
        Claim.above("fortune smiles", "Fig. 4", 0.0, "kf-alone/luck_1"),
        Claim("errors have a size", "Fig. 5", ("kf-alone/error_m",), lambda e: [1.0 + e**2], "squares are positive"),
        Claim.order("nobody measured it", "Fig. 3", "kf-alone/error_m", "kf-nobody/error_m"),
    ), piece=20)
"""


class Coin(NamedTuple):
    """The files of two such scenarios."""

    coin: str
    dice: str
    folder: Path

    def asked(self) -> set[str]:
        """What they were asked for: name.asked-seed-first-last."""
        return {path.name for path in self.folder.glob("*.asked-*")}


@pytest.fixture
def files(tmp_path: Path) -> Coin:
    for name, runs in (("coin", 30), ("dice", 60)):
        (tmp_path / f"{name}.py").write_text(COIN.replace("NAME", name).replace("RUNS", str(runs)))
    return Coin(str(tmp_path / "coin.py"), str(tmp_path / "dice.py"), tmp_path)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let results go to a folder of the test's own."""
    monkeypatch.chdir(tmp_path)


def reproduced(*words: str) -> Any:
    result = run("reproduce", *words, "--json")
    assert result.exit_code == 0, result.stderr
    assert all(TOLD.match(line) for line in result.stderr.splitlines())
    return strict_json(result.stdout)


def test_the_linear_scenario_as_json() -> None:
    answer = reproduced("li2022-linear", "--only", "kf-", "--runs", "20", "--seed", "3")
    assert list(answer) == ["scenario", "runs", "seed", "figures", "claims"]
    assert (answer["scenario"], answer["runs"], answer["seed"]) == ("li2022-linear", 20, 3)
    figures = {f["name"]: f for f in answer["figures"]}
    for row in ("alone", "ic", "naive", "arithmetic_average", "covariance_intersection"):
        for quantity in ("position_armse_m", "velocity_armse_mps"):
            assert figures[f"kf-{row}/{quantity}"]["published"] > 0
    for name, figure in figures.items():
        assert NAME.match(name), name
        assert list(figure) == ["name", "value", "standard_error", "published", "verdict", "reason"]
        assert figure["verdict"] in VERDICTS
        if "armse" in name:  # what a filter claims may be the same in every run
            assert 0 < figure["standard_error"] < 0.2 * figure["value"]
        assert (figure["verdict"] == "not given") == (figure["published"] is None)
    assert figures["kf-alone/position_armse_m"]["verdict"] == "agrees"
    assert figures["kf-ic/position_armse_m"]["verdict"] == "agrees"


def test_a_seed_decides_the_figures() -> None:
    first, again, other = (
        reproduced("li2022-linear", "--only", "kf-a", "--runs", "2", "--seed", s) for s in ("5", "5", "6")
    )
    assert first == again
    assert first["figures"][0]["value"] != other["figures"][0]["value"]


def test_of_one_run_the_error_is_not_known() -> None:
    answer = reproduced("li2022-linear", "--only", "kf-a", "--runs", "1")
    assert {f["standard_error"] for f in answer["figures"]} == {None}
    given = {f["verdict"] for f in answer["figures"] if f["published"] is not None}
    assert given == {"undecided"}
    assert {f["verdict"] for f in answer["figures"] if f["published"] is None} == {"not given"}
    assert {c["verdict"] for c in answer["claims"]} == {"undecided"}


@pytest.mark.slow
def test_without_runs_the_scenario_decides(files: Coin) -> None:
    assert reproduced(files.coin)["runs"] == 30
    assert files.asked() == {"coin.asked-0-0-20", "coin.asked-0-20-30"}
    assert reproduced(files.coin, "--publication")["runs"] == 900


def test_more_runs_are_added_until_all_is_decided(files: Coin, tmp_path: Path) -> None:
    """Fortune smiles by .3 standard deviations: 30 runs cannot tell, 120 and 240 can; what is done is kept."""
    text = (tmp_path / "coin.py").read_text().replace('float("nan")', "0.0")
    (tmp_path / "coin.py").write_text(text)
    answer = reproduced(files.coin, "--until-decided", "600")
    verdicts = {c["claim"]: c["verdict"] for c in answer["claims"]}
    assert verdicts["fortune smiles"] == "agrees"
    assert answer["runs"] in (60, 120, 240)
    asked = sorted(name.partition("-0-")[2] for name in files.asked())
    assert len(asked) == answer["runs"] // 20 + 1  # each piece of 20 once, and the last of 30 runs, which was half one


def test_the_limit_ends_it(files: Coin) -> None:
    assert reproduced(files.coin, "--until-decided", "50")["runs"] == 50  # a figure's error stays unknown
    assert reproduced(files.coin, "--until-decided", "20")["runs"] == 30


def test_several_names_give_a_list_each_once(files: Coin) -> None:
    answer = reproduced(files.dice, files.coin, files.dice, "--seed", "1")
    assert [(a["scenario"], a["runs"]) for a in answer] == [("dice", 60), ("coin", 30)]
    assert len(files.asked()) == 5


@pytest.mark.slow
def test_no_figure_depends_on_the_number_of_processes(tmp_path: Path) -> None:
    texts = []
    for jobs in ("1", "3"):
        out = tmp_path / f"jobs{jobs}"
        words = ("li2022-linear", "--only", "kf-a", "--runs", "120", "--jobs", jobs, "--out", str(out))
        assert run("reproduce", *words).exit_code == 0
        texts.append((out / "results.json").read_bytes())
    assert texts[0] == texts[1]


def test_what_is_written(files: Coin) -> None:
    result = run("reproduce", files.coin, files.dice, "--out", "here")
    assert "Written: here/report.html, here/results.json" in result.stdout
    (coin, dice) = strict_json(Path("here/results.json").read_text())
    assert (coin["scenario"], dice["scenario"]) == ("coin", "dice")
    assert {f["name"]: f["value"] for f in coin["figures"]}["kf-sum/heads_1"] == sum(range(30))
    assert coin["claims"] == [
        {
            "claim": "heads & tails are rare", "source": "Fig. 1", "verdict": "contradicts", "reason": "",
            "evidence": {"kf-sum/heads_1": 435.0},
        },
        {
            "claim": "all is better than one", "source": "Fig. 2", "verdict": "agrees", "reason": "",
            "evidence": {"kf-alone/error_m": pytest.approx(1.0), "kf-ic/error_m": pytest.approx(9.0)},
        },
        {
            "claim": "naive lies between", "source": "Fig. 2", "verdict": "undecided",
            "reason": "its error is not known",
            "evidence": {
                "kf-alone/error_m": pytest.approx(1.0), "kf-naive/error_m": 2.0,
                "kf-ic/error_m": pytest.approx(9.0),
            },
        },
        {
            "claim": "fortune smiles", "source": "Fig. 4", "verdict": "undecided",
            "reason": "too close to tell from these runs", "evidence": {"kf-alone/luck_1": pytest.approx(0.3)},
        },
        {
            "claim": "errors have a size", "source": "Fig. 5", "verdict": "by construction",
            "reason": "squares are positive", "evidence": {"kf-alone/error_m": pytest.approx(1.0)},
        },
    ]  # fmt: skip
    assert coin["charts"][0]["series"][0]["y"] == [1.0, None, 2.0]


class Page(HTMLParser):
    """Collects the text, what is referred to, and whether every tag is closed in order."""

    VOID = {"meta", "link", "img", "br", "wbr"}

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.references: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_is_whole_and_asks_for_nothing_from_outside(files: Coin) -> None:
    assert run("reproduce", files.coin, files.dice, "--out", "here").exit_code == 0
    text = Path("here/report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert {r for r in page.references if not r.startswith("data:")} == {"#coin", "#dice"}
    assert "url(" not in text
    words = " ".join(page.words)
    for wanted in (
        "A fair <coin>",
        "1.000 ± 0.010",
        "1.01",
        "contradicts",
        "by construction: squares are positive",
        "heads & tails are rare",
        "it is fair",
    ):
        assert wanted in words
    (picture, _) = [r for r in page.references if r.startswith("data:image/svg+xml")]
    image = base64.b64decode(picture.partition(",")[2]).decode()
    assert ElementTree.fromstring(image).tag == "{http://www.w3.org/2000/svg}svg"
    assert "Heads &amp; &lt;tails&gt;" in image


def test_the_table_shows_error_published_and_verdict(files: Coin) -> None:
    result = run("reproduce", files.coin)
    assert result.exit_code == 0
    assert "error / m, ± standard error" in result.stdout
    rows = [re.split(r" {2,}", line.rstrip()) for line in result.stdout.splitlines()]
    assert ["kf-alone", "1.000 ± 0.010", "1.01", "agrees"] in rows
    assert ["kf-ic", "9.000 ± 0.010", "0.5", "contradicts"] in rows
    assert ["kf-naive", "2", "not given"] in rows
    assert ["all is better than one (error / m: kf-alone 1, kf-ic 9)", "agrees"] in rows
    assert ["fortune smiles (luck: kf-alone 0.3)", "undecided: too close to tell from these runs"] in rows
    assert "30, seed 0" in result.stdout
    assert re.search(r"Assumed +it is fair", result.stdout)


def test_an_unknown_name_is_refused_before_anything_runs(files: Coin) -> None:
    line = refusal(run("reproduce", files.coin, "li2022-liner"))
    assert line.startswith("Unknown scenario 'li2022-liner'. Did you mean 'li2022-linear'? Valid: ")
    assert files.asked() == set()


def test_an_unknown_row_is_refused() -> None:
    assert "Unknown row 'kf-naiv_'. Did you mean 'kf-naive'" in refusal(
        run("reproduce", "li2022-linear", "--only", "kf-naiv_")
    )


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), "Give names of scenarios, or --all. See: track-fusion reproduce --help"),
        (("coin.py", "--all"), "Give names of scenarios, or --all. See: track-fusion reproduce --help"),
        (("coin.py", "--runs", "9", "--publication"), "Give --runs or --publication, not both."),
        (("coin.py", "--runs", "0"), "Invalid value for '--runs': 0 is not in the range x>=1."),
        (("coin.py", "--runs", "many"), "Invalid value for '--runs': 'many' is not a valid integer"),
        (("coin.py", "--seed", "-1"), "Invalid value for '--seed': -1 is not in the range x>=0."),
        (("coin.py", "--jobs", "0"), "Invalid value for '--jobs': 0 is not in the range x>=1."),
    ],
)
def test_wrong_options_are_refused(words: tuple[str, ...], line: str, files: Coin) -> None:
    assert refusal(run("reproduce", *words)).startswith(line)
    assert files.asked() == set()


@pytest.mark.slow
def test_progress_with_time_left_is_shown_on_a_terminal_only(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    shown: list[bytes] = []

    def read() -> None:
        try:
            while piece := os.read(ours, 4096):
                shown.append(piece)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    command = [
        sys.executable,
        "-m",
        "track_fusion.cli",
        "reproduce",
        "li2022-linear",
        "--only",
        "kf-",
        "--runs",
        "2",
        "--json",
        "--out",
    ]
    command.append(str(tmp_path))
    try:
        env = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
        done = subprocess.run(
            command, cwd=ROOT, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=theirs,
            timeout=DEADLINE_S,
        )  # fmt: skip
    finally:
        os.close(theirs)
        reader.join(DEADLINE_S)
        os.close(ours)
    text = b"".join(shown).decode()
    assert done.returncode == 0, text
    assert strict_json(done.stdout.decode())["runs"] == 2
    assert "li2022-linear, 2 runs" in text
    assert re.search(r"-:--:--|0:00:0\d", text)
