"""`instancemap bundle FOLDER`: pack the runs, tables and plugin code of an experiment into a ZIP file."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.runs.run_bundle import write_bundle


def main() -> None:
    """Run the command `instancemap bundle`."""
    parser = argparse.ArgumentParser(
        description="Pack the completed runs of an experiment into a ZIP file: configs, results, hashes, tables and "
        "the code of third-party plugins. `instancemap reproduce FILE` runs them again."
    )
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder of a sweep, or run directory")
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help="bundle; default: the name of FOLDER with .zip, in the current folder"
    )
    parser.add_argument("--with-maps", action="store_true", help="include meshes, maps and keyframes")
    parsed = arguments(parser)
    with one_line_errors():
        out = parsed.out or Path(f"{parsed.folder.resolve().name}.zip")
        count = write_bundle(parsed.folder, out, parsed.with_maps)
        print(f"{out}: {count} {'run' if count == 1 else 'runs'}, {out.stat().st_size / 1e6:.1f} MB")
