"""The command line, ``squilla``."""

import sys


def main() -> None:
    """Run the command line; what the person can mend is said in one line, with exit code 2."""
    from squilla.cli.app import app
    from squilla.errors import InputError

    try:
        app(prog_name="squilla")
    except InputError as error:
        print(f"squilla: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("squilla: interrupted", file=sys.stderr)
        sys.exit(130)
