"""What the package requires of others, by its own metadata, and what of that is installed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING

from sb3_torcs.errors import EXTRAS

if TYPE_CHECKING:
    from packaging.requirements import Requirement

__all__ = ["Check", "check_core", "check_extras"]

NAME = "sb3-torcs"
USERS = {
    "export": "export_actor",
    "races": "`race` and parallel_env",
    "reports": "lap reports, telemetry and reports of studies",
    "sbx": "algorithms of SBX",
    "study": "`study`",
    "video": "videos",
    "zoo": "the RL Zoo's own scripts and models of sb3-contrib",
}
"""What each extra is for."""


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    ok: bool
    found: str
    fix: str | None  # what to do; ``None`` when nothing is wrong


def check_core() -> list[Check]:
    """
    Compare what is installed with what everything needs.

    :return: one result per package
    """
    try:
        needed = _required("")
    except metadata.PackageNotFoundError:
        found = "not installed, so what it requires is not known"
        return [Check(NAME, False, found, "pip install --editable . (in a clone)")]
    return [_core(requirement) for requirement in needed]


def check_extras() -> list[Check]:
    """
    Compare what is installed with what the extras need: their packages may be missing, but not be
    of another version.

    :return: one result per extra
    """
    try:
        return [_extra(extra) for extra in sorted(set(EXTRAS.values()))]
    except metadata.PackageNotFoundError:  # of which the core's check tells
        return []


def _required(extra: str) -> list[Requirement]:
    """
    List what an extra requires on this machine, but for other extras.

    :param extra: its name; empty for the core
    """
    from packaging.requirements import Requirement

    every = [Requirement(line) for line in metadata.requires(NAME) or ()]
    return [
        one
        for one in every
        if re.sub(r"[-_.]+", "-", one.name).lower() != NAME
        and (not extra if one.marker is None else _applies(one, extra))
    ]


def _applies(requirement: Requirement, extra: str) -> bool:
    """Whether a requirement is one of this extra, and not of everything."""
    assert requirement.marker is not None
    evaluate = requirement.marker.evaluate
    return evaluate({"extra": extra}) and (not extra or not evaluate({"extra": ""}))


def _installed(requirement: Requirement) -> str | None:
    """Return the installed version of what is required."""
    try:
        return metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return None


def _fits(requirement: Requirement, version: str) -> bool:
    return requirement.specifier.contains(version, prereleases=True)


def _plain(requirement: Requirement) -> str:
    """Write a requirement as pip takes it, without its marker."""
    wanted = f"[{','.join(sorted(requirement.extras))}]" if requirement.extras else ""
    return f"{requirement.name}{wanted}{requirement.specifier}"


def _core(requirement: Requirement) -> Check:
    version, fix = _installed(requirement), f'pip install "{_plain(requirement)}"'
    if version is None:
        return Check(requirement.name, False, "not installed", fix)
    if not _fits(requirement, version):
        found = f"{version}; expected {requirement.specifier}"
        return Check(requirement.name, False, found, fix)
    return Check(requirement.name, True, version, None)


def _extra(extra: str) -> Check:
    name, needed = f"extra {extra}", _required(extra)
    versions = {one: version for one in needed if (version := _installed(one)) is not None}
    wrong = [one for one, version in versions.items() if not _fits(one, version)]
    if wrong:
        found = ", ".join(f"{one.name} {versions[one]}; expected {one.specifier}" for one in wrong)
        return Check(name, False, found, f'pip install "{NAME}[{extra}]"')
    missing = [one.name for one in needed if one not in versions]
    if missing:
        found = f'no {", ".join(missing)}; type: pip install "{NAME}[{extra}]"'
        return Check(name, True, f"{found}; only for {USERS[extra]}", None)
    return Check(name, True, ", ".join(f"{one.name} {versions[one]}" for one in needed), None)
