"""The command line as a whole: help, version, errors in one line, and what is imported when."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest
from cli.runner import ROOT, refusal, run, run_process

from track_fusion.cli.app import COMMANDS, version


def test_the_help_names_every_command_with_what_it_does() -> None:
    for words in ((), ("--help",), ("-h",)):
        result = run(*words)
        assert result.exit_code == 0
        for name in COMMANDS:
            assert re.search(rf"^  {name} +[A-Z].*\.$", result.stdout, re.MULTILINE), name


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_an_example(name: str) -> None:
    result = run(name, "--help")
    assert result.exit_code == 0
    assert re.search(rf"Examples?:.*track-fusion {name}\b", result.stdout, re.DOTALL)


def test_the_version_is_that_of_the_package() -> None:
    assert version() == ElementTree.parse(ROOT / "package.xml").findtext("version")
    assert run("--version").stdout == f"track-fusion {version()}\n"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("fuze",), "There is no command 'fuze'. Did you mean 'fuse'? There are: demo, fuse, "),
        (("--verson",), "No such option"),
        (("fuse",), "Missing option '--rule'. See: track-fusion fuse --help"),
        (("fuse", "--rule", "naive", "x"), "Got unexpected extra argument (x) See: track-fusion fuse --help"),
        (("rules", "--jason"), "No such option"),
    ],
)
def test_usage_errors_are_one_line(words: tuple[str, ...], line: str) -> None:
    assert refusal(run(*words)).startswith(line)


def loaded_by(*words: str) -> set[str]:
    """Return the modules loaded once a command has run."""
    script = (
        "import sys\nfrom track_fusion.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    done = run_process(*words, script=script)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.split())


@pytest.mark.parametrize("words", [("--help",), ("rules",)], ids=" ".join)
def test_a_command_loads_only_what_it_needs(words: tuple[str, ...]) -> None:
    modules = loaded_by(*words)
    assert not {"rclpy", "matplotlib", "rosbags", "track_fusion.nodes"} & modules
    if words == ("--help",):
        assert "numpy" not in modules or "track_fusion.rules" not in modules


@pytest.mark.parametrize(
    ("module", "words", "advice"),
    [
        ("click", ["rules"], "pip install '.[cli]' in the source tree"),
        ("rich", ["rules"], "pip install '.[cli]' in the source tree"),
        ("jsonschema", ["fuse", "--rule", "naive"], "pip install '.[cli]' in the source tree"),
    ],
)
def test_a_missing_package_is_one_line(module: str, words: list[str], advice: str) -> None:
    script = f"import sys; sys.modules[{module!r}] = None\nfrom track_fusion.cli import main\nmain()"
    done = run_process(*words, script=script)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr == f"track-fusion: the Python package {module} is missing: {advice}\n"


def test_a_reader_that_leaves_early_is_no_error() -> None:
    script = (
        "import subprocess, sys\n"
        "p = subprocess.Popen([sys.executable, '-m', 'track_fusion.cli', 'rules', '--json'], "
        "stdout=subprocess.PIPE, stderr=subprocess.PIPE)\n"
        "p.stdout.close()\n"
        "print(p.stderr.read().decode())\np.wait()"
    )
    assert "Traceback" not in run_process(script=script).stdout
