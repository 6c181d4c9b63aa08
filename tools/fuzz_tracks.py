"""Break the tracks of the installed game, and load and drive each of them in both worlds.

A broken file is either refused with TrackFileError or drives the road that is written in it.
Nothing crashes, hangs, or drives another road without a word. Ten thousand files take an hour on
two cores.
"""

from __future__ import annotations

import argparse
import multiprocessing
import re
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from sb3_torcs.backends.lite.backend import LiteBackend
from sb3_torcs.backends.native import NativeBackend
from sb3_torcs.car import CarState, Controls, Start
from sb3_torcs.errors import CarLost, InvalidOption, TrackFileError
from sb3_torcs.torcs.installation import find_game
from sb3_torcs.tracks.catalogue import load_track

PATIENCE = 120.0  # [s] for one file; the first one also compiles
PLACES = 4  # where each world begins to drive
TICKS = 25
VALUES = ("0", "-1", "1", "1e30", "-1e30", "1e-30", "1e9", "-0.001", "3.5", "180", "1000", "100000",
          "nan", "inf", "", "abc", "0x10", "1,5", "1e", "1_0", " 7 ", "0.00001")  # fmt: skip
WORDS = ("", "left", "right", "wall", "curb", "plan", "fence", "str", "lft", "rgt", "linear",
         "spline", "none", "grass", "tangent", "no pit", "a/b", "x" * 300)  # fmt: skip
UNITS = ("m", "deg", "rad", "km", "mm", "ft", "%", "furlong", "")
ENCODINGS = ("utf-16", "utf-8", "ascii", "cp500", "klingon", "big5", "utf-7", "shift_jis")

NUMBER = re.compile(r'<attnum\b[^>]*?\bval="([^"]*)"[^>]*/>')
TEXT = re.compile(r'<attstr\b[^>]*?\bval="([^"]*)"[^>]*/>')
NAMED = re.compile(r'<(?:attnum|attstr|section)\b[^>]*?\bname="([^"]*)"')
UNIT = re.compile(r'\bunit="([^"]*)"')
VALUE = re.compile(r"<att(?:num|str)\b[^>]*/>")
SECTION = re.compile(r"<section\b[^>]*>(?:(?!<section\b|</section>).)*</section>", re.DOTALL)
REASON = re.compile(r"'[^']*'|\S*\d\S*")
WORLDS = ("TorcsLite-v0", "Torcs-v0")
GOOD = {"refused", "equal", "car lost"}


class Breaker:
    """
    Breaks one thing of a text at a time.

    :param chance: decides what
    :param text: of a whole track
    """

    def __init__(self, chance: np.random.Generator, text: str) -> None:
        self.chance = chance
        self.text = text

    def pick(self, choices):
        """Choose one of several."""
        return choices[int(self.chance.integers(len(choices)))]

    def replace(self, pattern: re.Pattern[str], new: str) -> str:
        """Put something in the place of one of a pattern's groups."""
        found = [match.span(1) for match in pattern.finditer(self.text)]
        if not found:
            return self.text
        begin, end = self.pick(found)
        return self.text[:begin] + new + self.text[end:]

    def value(self) -> str:
        """Change a number, or a text."""
        if self.chance.random() < 0.6:
            return self.replace(NUMBER, self.pick(VALUES))
        return self.replace(TEXT, self.pick(WORDS))

    def name(self) -> str:
        """Give something the name of something else, or one with a slash."""
        other = self.pick(NAMED.findall(self.text) or ["none"])
        return self.replace(NAMED, "a/b" if self.chance.random() < 0.3 else other)

    def unit(self) -> str:
        """Change a unit."""
        return self.replace(UNIT, self.pick(UNITS))

    def remove(self) -> str:
        """Leave out a value or a section."""
        begin, end = self.pick(self._parts())
        return self.text[:begin] + self.text[end:]

    def double(self) -> str:
        """Have a value or a section twice."""
        begin, end = self.pick(self._parts())
        return self.text[:end] + self.text[begin:]

    def swap(self) -> str:
        """Exchange two neighbours."""
        parts = self._parts()
        first = int(self.chance.integers(len(parts) - 1))
        (a, b), (c, d) = parts[first : first + 2]
        text = self.text
        return text[:a] + text[c:d] + text[b:c] + text[a:b] + text[d:]

    def _parts(self) -> list[tuple[int, int]]:
        """Where the values are, or the innermost sections."""
        pattern = VALUE if self.chance.random() < 0.5 else SECTION
        return [match.span() for match in pattern.finditer(self.text)]

    def cut(self) -> str:
        """Leave out the end."""
        return self.text[: int(self.chance.integers(len(self.text)))]

    def encoding(self) -> str:
        """Declare another encoding."""
        new = f'encoding="{self.pick(ENCODINGS)}"'
        return re.sub(r'encoding="[^"]*"', new, self.text, count=1)

    def nest(self) -> str:
        """Put sections into sections, up to a hundred thousand deep."""
        deep = int(10.0 ** self.chance.uniform(0.0, 5.0))
        nest = '<section name="n">' * deep + "</section>" * deep
        return self.text.replace(MAIN, nest + MAIN)

    def letter(self) -> str:
        """Change one letter."""
        place = int(self.chance.integers(len(self.text)))
        return self.text[:place] + chr(int(self.chance.integers(1, 256))) + self.text[place + 1 :]


MAIN = '<section name="Main Track">'
KINDS = {
    "value": 6, "name": 3, "unit": 2, "remove": 4, "double": 2, "swap": 2, "cut": 1, "encoding": 1,
    "nest": 1, "letter": 2,
}  # fmt: skip
"""How often each is chosen."""


def finite(state: CarState) -> bool:
    """Whether all that a car knows is a number."""
    numbers = [np.ravel(value) for value in state]
    return bool(np.isfinite(np.concatenate(numbers)).all())


def drive(world, seed: int) -> str:
    """Drive here and there; say what went wrong, or nothing."""
    chance = np.random.default_rng(seed)
    for place in range(PLACES):
        start = Start(float(chance.uniform(0.0, world.track.length - 1.0)), 0.0, 0.0, 20.0)
        try:
            state = world.reset(chance, start if place else None)
            if not finite(state):
                return "not a number"
            for _ in range(TICKS):
                state = world.step(Controls(0.05, 1.0, 0.0), 1)
                if not finite(state):
                    return "not a number"
        except CarLost:
            return "car lost"  # told aloud
        except InvalidOption:
            continue  # no room there
    return ""


def try_native(path: Path, seed: int) -> str:
    """Load a track into the game's own physics, hold it to what was read, and drive."""
    world = NativeBackend(path)
    try:
        steps = load_track(path).steps
        road = world.engine.road()
        read = np.array([step[:8] for step in steps])
        if read.shape != road[:, :8].shape:
            return "another road"
        if not np.allclose(read, road[:, :8], rtol=1e-4, atol=1e-4):
            return "another road"
        if abs(world.engine.track_summary()["length"] - read[:, 0].sum()) > 1e-4 * read[:, 0].sum():
            return "another road"
        return drive(world, seed) or "equal"
    finally:
        world.close()


def try_lite(path: Path, seed: int) -> str:
    """Load a track into the world without the game, and drive."""
    return drive(LiteBackend(path), seed) or "equal"


def work(pipe: Connection) -> None:
    """Try files until the pipe closes."""
    while True:
        try:
            path, seed = pipe.recv()
        except EOFError:
            return
        for world in (try_lite, try_native):
            try:
                found = world(Path(path), seed), ""
            except TrackFileError as error:
                found = "refused", str(error)
            except Exception as error:
                found = f"raises {type(error).__name__}", str(error)
            pipe.send(found)


class Worker:
    """A process that may crash or hang; there is a new one then."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Begin a new process."""
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=work, args=(there,))
        self.process.start()
        there.close()

    def try_file(self, path: Path, seed: int) -> list[tuple[str, str]]:
        """Return what became of a file in each world, up to one that does not answer."""
        self.pipe.send((str(path), seed))
        found = []
        for _ in WORLDS:
            try:
                found.append(self.pipe.recv() if self.pipe.poll(PATIENCE) else ("HANG", ""))
            except (EOFError, ConnectionResetError):
                found.append(("CRASH", ""))
            if found[-1][0] in ("HANG", "CRASH"):
                self.end()
                self.start()
                break
        return found

    def end(self) -> None:
        """End the process, whatever it does."""
        self.pipe.close()
        self.process.kill()
        self.process.join()


def break_track(texts: dict[str, str], seed: int, number: int) -> tuple[str, str]:
    """Make one of the broken files: its name and its text."""
    chance = np.random.default_rng([seed, number])
    name = sorted(texts)[int(chance.integers(len(texts)))]
    kinds = [kind for kind, times in KINDS.items() for _ in range(times)]
    kind = kinds[int(chance.integers(len(kinds)))]
    return f"{number}-{kind}-{name}.xml".replace("/", "-"), getattr(
        Breaker(chance, texts[name]), kind
    )()


def fuzz(numbers: range, seed: int, keep: Path, counts: dict[str, Counter[str]]) -> None:
    """Try so many files; those that something is wrong with are kept and named."""
    texts = {
        name: path.read_bytes().decode("latin-1") for name, path in find_game().tracks().items()
    }
    worker = Worker()
    try:
        for number in numbers:
            name, text = break_track(texts, seed, number)
            path = keep / name
            path.write_bytes(text.encode("latin-1"))
            good = True
            for world, (found, message) in zip(WORLDS, worker.try_file(path, number), strict=False):
                counts[world][found] += 1
                if found == "refused":
                    counts["reasons"][REASON.sub("_", message.partition(": ")[2])[:80]] += 1
                if found not in GOOD:
                    good = False
                    print(f"{world}: {found}: {path} {message}", flush=True)
            if good:
                path.unlink()
    finally:
        worker.end()


def main() -> None:
    """Try as many files as asked for, and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracks", type=int, default=10_000, help="broken files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--keep", type=Path, default=Path("broken_tracks"), help="what goes wrong")
    options = parser.parse_args()
    options.keep.mkdir(parents=True, exist_ok=True)
    counts: dict[str, Counter[str]] = {name: Counter() for name in (*WORLDS, "reasons")}
    last = options.first + options.tracks
    with ThreadPoolExecutor(options.workers) as pool:
        shares = [
            range(options.first + share, last, options.workers) for share in range(options.workers)
        ]
        for done in [
            pool.submit(fuzz, share, options.seed, options.keep, counts) for share in shares
        ]:
            done.result()
    for reason, times in counts.pop("reasons").most_common():
        print(f"{times:6d}  {reason}")
    for world, found in counts.items():
        print(f"{world}: {found.total()} files: {dict(found.most_common())}")
    if any(set(found) - GOOD for found in counts.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
