"""Build the documentation as a site: ``make docs`` runs this. Warnings are errors.

Pages lie where GitHub shows them: in ``docs/``, at the top of the project, beside agents. They are
copied into one folder, their links follow, and pages of tables, classes and commands are added.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import sb3_torcs.callbacks
import sb3_torcs.cli
import sb3_torcs.errors
import sb3_torcs.policies
import sb3_torcs.vec_env

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build"
STAGE = BUILD / "docs-source"
SITE = BUILD / "docs"
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")

SECTIONS = {  # of the site's menu
    "Begin": ["install", "quickstart", "agents", "glossary"],
    "How to": [
        "training", "own-reward", "tracks", "many-cars", "evaluation", "compare", "racing",
        "studies", "scr", "window", "fastest-lap", "examples",
    ],
    "Reference": ["environments", "policies", "commands", "reference/index", "reference/commands"],
    "Results": [
        "leaderboard", "results", "results-tracks", "results-racing", "results-ddpg",
        "what-we-learned", "results/index",
    ],
    "Inside": [
        "engine", "architecture", "reliability", "contributing", "tools", "security", "changelog",
        "credits",
    ],
}  # fmt: skip

CLASSES = {  # documented by their docstrings
    "Environments": [
        "sb3_torcs.envs.torcs.TorcsEnv",
        "sb3_torcs.envs.torcs_lite.TorcsLiteEnv",
        *[
            f"sb3_torcs.envs.options.{name}Options"
            for name in ("End", "Condition", "Picture", "Scr")
        ],
        "sb3_torcs.car.CarState",
        "sb3_torcs.car.Controls",
    ],
    "Vector environments": [f"sb3_torcs.vec_env.{name}" for name in sb3_torcs.vec_env.__all__],
    "Callbacks": [
        f"sb3_torcs.callbacks.{name}"
        for name in sb3_torcs.callbacks.__all__
        if name.endswith("Callback")
    ],
    "Policies": [f"sb3_torcs.policies.{name}" for name in sb3_torcs.policies.__all__],
    "Errors": [
        f"sb3_torcs.errors.{name}"
        for name in sb3_torcs.errors.__all__
        if isinstance(getattr(sb3_torcs.errors, name), type)
    ],
}


def sources() -> dict[Path, Path]:
    """Return where each page of the project stands in the site."""
    pages = {ROOT / "README.md": Path("index.md")}
    for name in ("LEADERBOARD", "CONTRIBUTING", "SECURITY", "CHANGELOG"):
        pages[ROOT / f"{name}.md"] = Path(f"{name.lower()}.md")
    for folder in ("examples", "tools"):
        pages[ROOT / folder / "README.md"] = Path(f"{folder}.md")
    for page in sorted((ROOT / "docs").glob("*.md")):
        pages[page] = Path(page.name)
    for card in sorted((ROOT / "sb3_torcs" / "agents").glob("*/README.md")):
        pages[card] = Path("agents") / f"{card.parent.name}.md"
    for table in sorted((ROOT / "docs" / "results").glob("*.csv")):
        pages[table] = Path("results") / f"{table.stem}.md"
    return pages


def follow_links(text: str, source: Path, pages: dict[Path, Path]) -> str:
    """Let the links of a page lead to where the site has what they name."""

    def lead(match: re.Match[str]) -> str:
        target = match[2]
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        path = (source.parent / target).resolve()
        path = path / "README.md" if path.is_dir() else path
        if path not in pages and path.is_relative_to(ROOT / "docs"):
            place = path.relative_to(ROOT / "docs")
        elif path not in pages:
            place = Path("files") / path.relative_to(ROOT)
            (STAGE / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, STAGE / place)
        else:
            place = pages[path]
        return match[1] + os.path.relpath(place, pages[source].parent) + match[3]

    return LINK.sub(lead, text)


def write_page(place: Path, text: str) -> None:
    """Write a page of the site's sources."""
    (STAGE / place).parent.mkdir(parents=True, exist_ok=True)
    (STAGE / place).write_text(text, encoding="utf-8")


def toctree(names: list[str], caption: str = "", hidden: bool = True) -> str:
    """Return a menu of pages."""
    options = [f":caption: {caption}"] * bool(caption) + [":hidden:"] * hidden
    return "\n".join(["", "```{toctree}", *options, ":maxdepth: 1", "", *names, "```", ""])


def table_page(table: Path, row: dict[str, str]) -> str:
    """Return the page of one table of the results."""
    facts = [
        f"Measured: {row['measured']}." if row["measured"] else "",
        f"Commit: {row['commit']}." if row["commit"] else "",
        f"Command: `{row['command']}`." if row["command"] else "",
    ]
    title = row["what"][0].upper() + row["what"][1:]
    head = f"# {title}\n\nFile: `{table.name}`. {' '.join(facts)}\n\n"
    source = os.path.relpath(table, STAGE / "results")
    return f"{head}```{{csv-table}}\n:file: {source}\n:header-rows: 1\n```\n"


def write_tables(pages: dict[Path, Path]) -> None:
    """Write a page per table, and one that lists them."""
    index = ROOT / "docs" / "results" / "index.csv"
    rows = {row["file"]: row for row in csv.DictReader(index.open(encoding="utf-8"))}
    names = []
    for table, place in pages.items():
        if table.suffix == ".csv" and table != index:
            write_page(place, table_page(table, rows[table.name]))
            names.append(place.stem)
    lines = [f"| [{name}]({name}.md) | {rows[f'{name}.csv']['what']} |" for name in names]
    listed = "\n".join(["| table | what |", "|---|---|", *lines, ""])
    text = "# Tables\n\n`(;)`: a cell with several values. `(of)`: of how many.\n\n"
    short = [f"{name} <{name}>" for name in names]  # their titles are too long for a menu
    write_page(Path("results/index.md"), f"{text}{listed}{toctree(short)}")


def write_reference() -> None:
    """Write the pages that docstrings and ``--help`` fill."""
    names = []
    for title, paths in CLASSES.items():
        name = title.lower().replace(" ", "-")
        names.append(name)
        blocks = [document(path) for path in paths]
        write_page(Path(f"reference/{name}.md"), "\n".join([f"# {title}", "", *blocks]))
    text = "# Classes\n\nBy their docstrings.\n"
    write_page(Path("reference/index.md"), text + toctree(names, hidden=False))
    helps = [f"## {verb}\n\n```text\n{help_of(verb)}```\n" for verb in verbs()]
    write_page(Path("reference/commands.md"), "\n".join(["# Options of the commands", "", *helps]))


def document(path: str) -> str:
    """Return the directive that documents a class or function."""
    module, _, name = path.rpartition(".")
    thing = getattr(sys.modules.get(module) or __import__(module, fromlist=[name]), name)
    kind = "autoclass" if isinstance(thing, type) else "autofunction"
    return f"```{{eval-rst}}\n.. {kind}:: {path}\n```\n"


def verbs() -> list[str]:
    """Return the names of the commands, in the order of ``--help``."""
    return [verb.__name__.rpartition(".")[2].replace("_", "-") for verb in sb3_torcs.cli.VERBS]


def help_of(verb: str) -> str:
    """Return what ``sb3-torcs VERB --help`` prints."""
    os.environ["COLUMNS"] = "90"
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        sb3_torcs.cli.main([verb, "--help"])
    return out.getvalue()


def stage() -> None:
    """Copy pages and pictures into one folder, and add what is generated."""
    shutil.rmtree(STAGE, ignore_errors=True)
    for name in ("images", "static"):
        shutil.copytree(ROOT / "docs" / name, STAGE / name)
    shutil.copyfile(ROOT / "docs" / "conf.py", STAGE / "conf.py")
    pages = sources()
    for source, place in pages.items():
        if source.suffix == ".md":
            text = follow_links(source.read_text(encoding="utf-8"), source, pages)
            write_page(place, text)
    write_tables(pages)
    write_reference()
    with (STAGE / "index.md").open("a", encoding="utf-8") as home:
        home.writelines(toctree(names, caption) for caption, names in SECTIONS.items())
    with (STAGE / "agents.md").open("a", encoding="utf-8") as agents:
        cards = sorted(place.as_posix() for place in pages.values() if place.parts[0] == "agents")
        agents.write(toctree([card.removesuffix(".md") for card in cards]))


def main() -> int:
    """Build the site, and return Sphinx's exit status."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    stage()
    options = ["-W", "--keep-going", "-q", "-j", "auto", "-d", str(BUILD / "docs-cache")]
    done = subprocess.run([sys.executable, "-m", "sphinx", *options, str(STAGE), str(SITE)])
    if done.returncode == 0:
        print(f"{SITE / 'index.html'}")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
