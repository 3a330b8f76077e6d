"""The group of commands, each loaded when it is called, and the form in which errors are told."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import click

from track_fusion.params import Fault, nearest

#: Commands in the order of the help; command x is the function x of track_fusion/cli/x.py.
COMMANDS = ("demo", "fuse", "rules", "scenarios", "reproduce", "compare", "record", "bag")
#: Exit code for wrong input: a field, a parameter, an option.
WRONG_INPUT = 2
#: Exit code of a process that was interrupted, by the custom of shells.
INTERRUPTED = 130


class Application(click.Group):
    """Loads a command when it is needed, and tells an error in one line: 2 for wrong input, 1 for a fault."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Name the commands."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command."""
        if cmd_name not in COMMANDS:
            return None
        command = getattr(importlib.import_module(f"track_fusion.cli.{cmd_name}"), cmd_name)
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; say the nearest one when there is none of that name."""
        if args and not args[0].startswith("-") and args[0] not in COMMANDS:
            raise click.UsageError(
                f"There is no command '{args[0]}'.{nearest(args[0], COMMANDS)} There are: {', '.join(COMMANDS)}."
            )
        return super().resolve_command(ctx, args)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run; every error that is not ours to mend is one line on standard error."""
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, False, **extra)
        try:
            code = super().main(args, prog_name, complete_var, False, **extra)
        except click.UsageError as error:
            name = error.ctx.command_path if error.ctx else prog_name
            _end(f"{error.format_message()} See: {name} --help", WRONG_INPUT)
        except click.ClickException as error:
            _end(error.format_message(), error.exit_code)
        except (click.Abort, KeyboardInterrupt):
            _end("Interrupted.", INTERRUPTED)
        # LinAlgError and ParameterError are ValueErrors; a number too large for a float is an OverflowError.
        except (ValueError, OverflowError) as error:
            _end(str(error) or type(error).__name__, WRONG_INPUT)
        except (OSError, Fault) as error:
            _end(str(error), 1)
        sys.exit(code if isinstance(code, int) else 0)


def _end(text: str, code: int) -> NoReturn:
    click.echo(" ".join(text.split()), err=True)
    sys.exit(code)


def version() -> str:
    """Return this package's version: what package.xml of the source tree says, or what was installed."""
    manifest = Path(__file__).parents[2] / "package.xml"
    if manifest.is_file():
        from xml.etree import ElementTree

        return ElementTree.parse(manifest).findtext("version") or "unknown"
    from importlib import metadata

    return metadata.version("track_fusion")


def _print_version(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked:
        click.echo(f"track-fusion {version()}")
        ctx.exit()


@click.group(cls=Application, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Show the version."
)
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Fuse tracks of several sensors: try a rule, see what there is, repeat the published studies, run over ROS 2.

    \b
    track-fusion rules                         which rules there are, and what each promises
    track-fusion reproduce li2022-linear       measured beside published
    track-fusion demo                          the same over real ROS 2 nodes
    track-fusion COMMAND --help                more on one command, with examples
    """  # noqa: D301  click reads \b as "do not wrap"
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
