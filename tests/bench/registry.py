"""All metrics of `make bench`: one file a group."""

from __future__ import annotations

from tests.bench import study, virtual_time
from tests.bench.metric import Group

GROUPS: dict[str, Group] = {
    "P11": virtual_time.measure,
    "P12": study.measure,
}
