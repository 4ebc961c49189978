"""Which worker runs which file: files of a room go to one worker, which compiles their programs once."""

from collections import Counter
from typing import Any

from xdist.scheduler import LoadFileScheduling


class RoomScheduling(LoadFileScheduling):
    """A worker takes the files of its room, then those of the largest room that no other worker has, then any."""

    def __init__(self, *args: Any):
        super().__init__(*args)
        self._rooms: dict[Any, str] = {}

    def _assign_work_unit(self, node: Any) -> None:
        waiting: Counter[str] = Counter()
        for file, tests in self.workqueue.items():
            waiting[_room(file)] += len(tests)
        own = self._rooms.pop(node, None)
        held = set(self._rooms.values())
        file = max(self.workqueue, key=lambda file: (_room(file) == own, _room(file) not in held, waiting[_room(file)]))
        self._rooms[node] = _room(file)
        self.workqueue.move_to_end(file, last=False)
        super()._assign_work_unit(node)


def _room(file: str) -> str:
    """The folder of a file; a file beside the rooms is one of its own."""
    folder = file.rpartition("/")[0]
    return folder if "/" in folder else file
