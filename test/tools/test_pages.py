"""What the pages point to is there: links, files, targets of make, stages of its tests."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.run_tests import STAGES

ROOT = Path(__file__).resolve().parents[2]
PAGES = ["README.md", "CONTRIBUTING.md", *(f"doc/{path.name}" for path in sorted((ROOT / "doc").glob("*.md")))]
FOLDERS = "benchmark|config|doc|launch|msg_adapters|test|tools|track_fusion"


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def section(page: str, heading: str) -> str:
    return text(page).split(f"\n## {heading}\n")[1].split("\n## ")[0]


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    prose = re.sub(r"^```.*?^```", "", text(page), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", prose):
        assert (ROOT / page).parent.joinpath(target).exists(), target


@pytest.mark.parametrize("page", PAGES)
def test_files_that_are_named_exist(page: str) -> None:
    """In backticks, from the root; <rule> and * stand for some name."""
    for name in re.findall(rf"`((?:{FOLDERS})/[^`\s]*)`", text(page)):
        assert list(ROOT.glob(re.sub(r"<\w+>", "*", name))), name


@pytest.mark.parametrize("page", PAGES)
def test_targets_of_make_exist(page: str) -> None:
    targets = set(re.findall(r"^([a-z-]+):", text("Makefile"), re.MULTILINE))
    named = re.findall(r"`make ([a-z-]+)|^make ([a-z-]+)", text(page), re.MULTILINE)
    assert {"".join(pair) for pair in named} <= targets


def test_stages_that_are_named_exist() -> None:
    named = re.search(r'STAGES="([^"]+)"', section("CONTRIBUTING.md", "Set up"))
    assert named is not None
    assert set(named[1].split()) <= set(STAGES)
    assert set(STAGES) <= set(re.findall(r"`([a-z-]+)`", section("CONTRIBUTING.md", "Set up")))


def test_the_way_of_a_message_has_at_most_seven_stops_each_in_a_file() -> None:
    stops = re.findall(r"^\d+\. (.*)$", section("doc/architecture.md", "The way of a message"), re.MULTILINE)
    assert 3 <= len(stops) <= 7
    assert all(re.match(r"`[\w/]+\.py` ", stop) for stop in stops)


def test_the_readme_leads_to_the_architecture() -> None:
    for page in ("README.md", "CONTRIBUTING.md"):
        assert "(doc/architecture.md)" in text(page)
