"""Which runs of the stages belong together.

Every run of a stage has an instance: a name that begins with its time of birth, so that of two the later is the
greater. It stands in the run's liveliness token, with the instances that it is made from (its lineage). When an input
comes with a new instance, everything made from the old one is void.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Iterable, Mapping, Sequence

_INSTANCE = re.compile(r"[0-9a-f]{24}")
_MANY = 256  # instances remembered per stage; a flood of tokens must not fill memory

Lineage = Mapping[str, str]


def new_instance() -> str:
    """A name for a run that starts now: 16 hexadecimal digits of Unix time, ns, and 8 random ones."""
    return f"{time.time_ns():016x}{secrets.token_hex(4)}"


def write_lineage(lineage: Lineage) -> str:
    """A lineage as one chunk of a key, e.g. ``ingest=0187...``; ``-`` for none."""
    return "+".join(f"{stage}={instance}" for stage, instance in sorted(lineage.items())) or "-"


def read_lineage(text: str) -> dict[str, str]:
    """A lineage from a chunk of a key.

    Raises
    ------
    ValueError
        If it is none.
    """
    if text == "-":
        return {}
    lineage = {}
    for part in text.split("+"):
        stage, _, instance = part.partition("=")
        if not stage or not _INSTANCE.fullmatch(instance):
            raise ValueError(f"lineage {text[:80]!r}")
        lineage[stage] = instance
    return lineage


class Ancestry:
    """The runs of some stages that are known, and those that belong together.

    Attributes
    ----------
    current : dict of str to str
        The chosen instance of each stage; empty while there is none.
    """

    def __init__(self, stages: Sequence[str]) -> None:
        self.current = dict.fromkeys(stages, "")
        self._alive: dict[str, dict[str, Lineage]] = {stage: {} for stage in stages}
        self._known: dict[str, Lineage] = {}  # lineages of the current instances, alive or not
        self._void: dict[str, dict[str, None]] = {stage: {} for stage in stages}

    def appear(self, stage: str, instance: str, lineage: str) -> None:
        """A token is there; what is no instance or lineage is ignored."""
        if stage not in self._alive or not _INSTANCE.fullmatch(instance) or len(self._alive[stage]) >= _MANY:
            return
        try:
            self._alive[stage][instance] = read_lineage(lineage)
        except ValueError:
            return

    def leave(self, stage: str, instance: str) -> None:
        """A token has gone."""
        self._alive.get(stage, {}).pop(instance, None)

    def is_alive(self, stage: str) -> bool:
        """Whether the current instance of a stage is there."""
        return self.current[stage] in self._alive[stage]

    def choose(self) -> dict[str, str]:
        """The newest instances that fit together; one that has gone stays until there is another."""
        chosen: dict[str, str] = {}
        for _ in self.current:  # a stage may come before what it is made from
            for stage in self.current:
                chosen[stage] = self._best(stage, chosen)
        return chosen

    def _best(self, stage: str, chosen: Mapping[str, str]) -> str:
        alive = self._alive[stage]
        candidates: dict[str, Lineage] = {k: v for k, v in alive.items() if k not in self._void[stage]}
        if self.current[stage]:
            candidates.setdefault(self.current[stage], self._known[stage])
        fitting = [
            (instance in alive, instance)
            for instance, lineage in candidates.items()
            if all(chosen.get(one) == made for one, made in lineage.items() if one in self.current)
        ]
        return max(fitting, default=(False, ""))[1]

    def replaced(self, chosen: Mapping[str, str]) -> list[str]:
        """Stages whose current instance another one has replaced, or that are made from such a one."""
        return [stage for stage, instance in self.current.items() if instance and chosen[stage] != instance]

    def adopt(self, chosen: Mapping[str, str]) -> Iterable[str]:
        """Make these the current instances, and those before them void; the answer is the stages that are new."""
        new = []
        for stage, instance in chosen.items():
            before = self.current[stage]
            if instance == before:
                continue
            if before:
                void = self._void[stage]
                void[before] = None
                if len(void) > _MANY:
                    del void[next(iter(void))]
            self.current[stage] = instance
            if instance:
                self._known[stage] = self._alive[stage][instance]
                new.append(stage)
        return new
