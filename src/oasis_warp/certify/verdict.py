"""Measurements summed up: for each operator and check how many, and the one nearest to its bound or beyond."""

import importlib.metadata
import platform
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch

from oasis_warp.certify.compare import Measurement


@dataclass
class Tally:
    """All measurements of one check of one operator."""

    worst: Measurement
    cases: int = 0
    failures: int = 0

    @property
    def passed(self) -> bool:
        """Whether none failed."""
        return self.failures == 0


@dataclass
class Verdict:
    """Tallies by operator and check, in the order of their first measurement, and all failures."""

    rows: dict[tuple[str, str], Tally] = field(default_factory=dict)
    failed: list[Measurement] = field(default_factory=list)
    conditions: dict[tuple[str, str, str], Tally] = field(default_factory=dict)
    """The same for each kind of scene."""

    def add(self, measurements: Iterable[Measurement]) -> None:
        """Count these."""
        for m in measurements:
            _count(self.rows, (m.family, m.check), m)
            _count(self.conditions, (m.family, m.check.removesuffix(", stiff"), m.scene.split(", seed")[0]), m)
            if not m.passed:
                self.failed.append(m)

    @property
    def passed(self) -> bool:
        """Whether something was measured and nothing failed."""
        return bool(self.rows) and not self.failed


def _count(rows: dict, key: tuple[str, ...], m: Measurement) -> None:
    row = rows.setdefault(key, Tally(m))
    row.cases += 1
    row.failures += not m.passed
    if m.load > row.worst.load:
        row.worst = m


def describe_machine(device: torch.device) -> dict[str, Any]:
    """Device and versions that the numbers belong to."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    return {
        "device": f"{device} ({name})",
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": importlib.metadata.version("warp-lang"),
        "threads": torch.get_num_threads(),
    }


def as_table(verdict: Verdict) -> list[dict[str, Any]]:
    """The tallies by check, for JSON."""
    return [_entry({"family": family, "check": check}, row) for (family, check), row in verdict.rows.items()]


def by_condition(verdict: Verdict) -> list[dict[str, Any]]:
    """The tallies by check and kind of scene, for JSON."""
    return [
        _entry({"family": family, "check": check, "condition": condition}, row)
        for (family, check, condition), row in verdict.conditions.items()
    ]


def _entry(key: dict[str, str], row: Tally) -> dict[str, Any]:
    return key | {
        "error": row.worst.error,
        "bound": row.worst.bound,
        "where": row.worst.scene,
        "cases": row.cases,
        "failures": row.failures,
    }
