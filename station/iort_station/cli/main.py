"""The command `iort`: its global options, its commands and its exit status."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from botocore.exceptions import BotoCoreError, ClientError

from iort_analysis import AnalysisError
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_station.cli.options import CloudOptions, option, say
from iort_station.cli.verbs import Verbs
from iort_station.cloud import EMBEDDED, EMBEDDED_VARIABLE
from iort_station.errors import StationError, UsageError

# Numpy and botocore make a hundred thousand objects that stay. Looking for garbage among them after every 700
# new ones took a tenth of a command's processor time.
_GARBAGE_AFTER = 50_000
# Without markup, help needs no rich, whose import takes as long as everything else.
app = typer.Typer(
    cls=Verbs,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="The operator's station of iort.",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(asked: bool) -> None:  # noqa: FBT001 - typer passes it by position
    if asked:
        # It reads packages' descriptions with a parser for mail.
        from importlib.metadata import version  # noqa: PLC0415 - see above

        typer.echo(f"iort {version('iort-station')}")
        raise typer.Exit


@app.callback()
def _cloud_options(
    context: typer.Context,
    namespace: Annotated[str, option("The deployment's namespace.")] = DEFAULT_NAMESPACE,
    profile: Annotated[str | None, option("AWS profile.")] = None,
    region: Annotated[str | None, option("AWS region.")] = None,
    local: Annotated[
        bool, option("Use the embedded cloud; the default if one runs and no AWS option is given.", "--local")
    ] = False,
    embedded: Annotated[
        Path | None,
        option(
            f"The file of an embedded cloud. Default: {EMBEDDED} in this folder or one above, or else "
            "that of `make up`.",
            envvar=EMBEDDED_VARIABLE,
        ),
    ] = None,
    _version: Annotated[
        bool, option("Print the version.", "--version", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    context.obj = CloudOptions(namespace, profile, region, local, embedded)


def said(error: OSError) -> str:
    """The operating system's error without its number: the file and the problem."""
    return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)


def main() -> None:
    """Run the command. An expected error prints one line on standard error; the status is 2 for wrong use,
    and otherwise 1."""
    gc.set_threshold(_GARBAGE_AFTER)
    try:
        app(prog_name="iort")
    except UsageError as error:
        _end(*error.args, status=2)
    except (StationError, AnalysisError) as error:
        _end(*error.args)
    except ClientError as error:
        _end(f"AWS refused a call: {error}")
    except BotoCoreError as error:
        _end(f"AWS could not be called: {error}")
    except BrokenPipeError:
        # Whoever read the pipe has seen enough. Python would complain about the rest at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        _end(said(error))
    except KeyboardInterrupt:
        sys.exit(130)


def _end(*lines: str, status: int = 1) -> NoReturn:
    say(*lines)
    sys.exit(status)


if __name__ == "__main__":
    main()
