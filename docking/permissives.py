"""What must be given before a move: read from the wire where it is wired, declared by the operator where it is not."""

from __future__ import annotations

from docking.errors import PermissiveMissing
from docking.ports import Journal, Motion, Operator


class Permissives:
    """Asks for permissives and keeps in the journal who gave them."""

    def __init__(self, motion: Motion, journal: Journal, operator: Operator) -> None:
        self._motion, self._journal, self._operator = motion, journal, operator

    async def require(self, names: tuple[str, ...], stage: str) -> None:
        """Return when all are given. Raises PermissiveMissing where one is not and nobody is there to wait for."""
        given = self._motion.inputs().given
        wired = tuple(name for name in names if name in given)
        declared = tuple(name for name in names if name not in given)
        missing = await self._lacking(wired) or await self._operator.permissives(declared)
        body = {"stage": stage, "declared": [n for n in declared if n not in missing], "missing": list(missing)}
        self._journal.write("permissives", {**body, "wired": [n for n in wired if n not in missing]})
        if missing:
            raise PermissiveMissing(missing[0], value=stage)

    async def again(self, names: tuple[str, ...], stage: str) -> None:
        """The same for those that are wired, after a person has taken time to decide."""
        missing = await self._lacking(tuple(name for name in names if name in self._motion.inputs().given))
        if missing:
            raise PermissiveMissing(missing[0], value=stage)

    async def _lacking(self, wired: tuple[str, ...]) -> tuple[str, ...]:
        """Wait as long as the operator does; the first that is not given then, or nothing."""
        while lacking := [name for name in wired if self._motion.inputs().given.get(name) is not True]:
            if not await self._operator.wait_for(lacking[0]):
                return (lacking[0],)
        return ()
