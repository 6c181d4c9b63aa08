"""One word for one thing, and plain words: what `docs/glossary.md` rules out stands nowhere."""

from __future__ import annotations

import ast
import re

from lint import ROOT, assert_none, source, tracked

ABOUT_WORDS = {"docs/glossary.md", "tests/test_glossary.py"}
NOT_OURS = {"LICENSE"}
RECORDS = re.compile(r"sb3_torcs/agents/[\w-]+/(args|config)\.yml")  # what a training has stored
ENDINGS = {".py", ".pyi", ".md", ".yml", ".cfg", ".toml", ".h", ".cpp", ""}

BANNED = {  # what to say instead: the words not to use for it, and where, if not everywhere
    "timestep": (r"decision", r"\btime[- ]steps?\b", r"\b(share|some) of the steps\b"),
    "timestep, where a noise or a callback counts": (r"\bframes?\b",),
    "video": (r"films?\b", r"filmed", r"filming"),
    "replay buffer": (r"\breplay[- _]memor", r"memor(y|ies)"),
    "grid slot": (r"\bgrid[- ](place|position)", r"\bstarting[- ](place|position)"),
    "folder": (r"\banother place\b",),
    "motor": (r"\bengine speed", r"\bengine[_ ](torque|inertia|brake|revs)"),
}
ONLY_IN = {
    "timestep, where a noise or a callback counts": re.compile(
        r"sb3_torcs/noise\.py|sb3_torcs/callbacks/(exploration|learning)\.py|zoo_configs/"
        r"|examples/studies/|tests/test_noise\.py"
    ),
}
ALLOWED = (
    # stored, or typed by people
    r"[\"'`]decisions[\"'`]", r"\[\"decisions\"\]", r"line_decisions", r"noise/frames",
    r"--film", r"grid_place", r"[\"'`(]frames\b", r"in frames,",
    # Python's, NumPy's, C++'s, the operating system's
    r"memoryview", r"MemoryError", r"shares_memory", r"<memory>", r"memory_order_\w+",
    # SB3's
    r"optimize_memory_usage",
    # RAM
    r"test_torcs_memory", r"\b(in|of|no|other|own|copy|has the|fills the|filling the) memory\b",
    r"_memory\b", r"\bmemory\(", r"\bmemory (of|in)\b",
)  # fmt: skip
RAM = re.compile(  # whole files that are about it
    r"sb3_torcs/native/|docs/(architecture|engine|reliability)\.md|tests/test_(torcs_memory|native"
    r"|scr_backend|scr_server)|tests/test_(contract|torcs_vector)\.py|sb3_torcs/bench/torcs\.py"
    r"|sb3_torcs/agents/model_file\.py|tests/test_model_record\.py"
)


def tracked_texts():
    for name in tracked():
        path = ROOT / name
        if name in ABOUT_WORDS | NOT_OURS or RECORDS.match(name) or not path.is_file():
            continue
        if path.suffix in ENDINGS:
            yield name, source(path)


def misnamed(text, name="sb3_torcs/cli/watch.py"):
    """What a text calls by another word than the glossary's, with the lines' numbers."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        rest = re.sub("|".join(ALLOWED), "", line)
        for word, patterns in BANNED.items():
            if word in ONLY_IN and not ONLY_IN[word].match(name):
                continue
            if word == "replay buffer" and RAM.match(name):
                continue
            said = re.search("|".join(patterns), rest, re.IGNORECASE)
            if said:
                found.append(f"{name}:{number}: '{said[0]}'; say {word}")
    return found


def test_everybody_uses_the_words_of_the_glossary():
    """In the names of files, too."""
    assert_none(
        fault
        for name, text in tracked_texts()
        for fault in [*misnamed(name, name), *misnamed(text, name)]
    )


def test_the_glossary_has_every_word():
    page = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    for word in BANNED:
        assert f"\n| {word.partition(',')[0]} |" in page


# ------------------------------------------------------------------------------ plain words


PLAIN = {  # what to write: the words not to use for it
    "again, new": r"anew",
    "the same, equal, both": r"alike",
    "also, other than": r"besides",
    "who, anyone who": r"whoever|whosever",
    "no one, or name who": r"nobody",
    "its own": r"of (?:its|their|one's) own",
    "is, yields, reaches": r"(?:come|comes|came|coming) to(?! a (?:stand|stop)\b)",
    "report, show, write, name": r"tell|tells|told|telling",
    "print, write, report, name": r"say|says|said|saying",
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
GENERATED = re.compile(r"<!-- ([\w-]+) -->\n.*?<!-- /\1 -->", re.DOTALL)  # from docstrings


def stilted(text, name="page.md"):
    """What a text writes in words that are not plain, with the lines' numbers."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        for better, pattern in PLAIN.items():
            word = re.search(rf"\b(?:{pattern})\b", line, re.IGNORECASE)
            if word:
                found.append(f"{name}:{number}: '{word[0]}'; write: {better}")
    return found


def prose_of(path):
    """A page without its generated tables, whose lines stay counted."""
    return GENERATED.sub(lambda m: "\n" * m[0].count("\n"), path.read_text(encoding="utf-8"))


def prose_in_code(path):
    """
    Docstrings, errors that are raised, and texts of ``--help``, each on its line.

    To check a file of the package: ``stilted(prose_in_code(path), path.name)``.
    """
    lines = [""] * len(path.read_text(encoding="utf-8").splitlines())
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        parts = []
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node):
            parts = [node.body[0].value]
        elif isinstance(node, ast.Raise) and node.exc:
            parts = [part for part in ast.walk(node.exc) if isinstance(part, ast.Constant)]
        elif isinstance(node, ast.keyword) and node.arg in ("help", "description", "epilog"):
            parts = [part for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
        for part in parts:
            if isinstance(part.value, str):
                for offset, line in enumerate(part.value.splitlines()):
                    at = min(part.lineno - 1 + offset, len(lines) - 1)
                    lines[at] += " " + line
    return "\n".join(lines)


def pages():
    """All pages that people read: docs, those beside them, cards of agents."""
    folders = (ROOT, ROOT / "docs", ROOT / "examples", ROOT / "tools")
    yield from (page for folder in folders for page in sorted(folder.glob("*.md")))
    yield from sorted((ROOT / "sb3_torcs" / "agents").glob("*/README.md"))


def test_pages_are_written_in_plain_words():
    found = [
        fault for page in pages() for fault in stilted(prose_of(page), str(page.relative_to(ROOT)))
    ]
    assert not found, "\n".join(found)
