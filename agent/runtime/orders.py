"""What an operator may ask of the running robot, one handler a command; they run on the control socket's thread."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from agent.runtime import snapshot as snapshots
from agent.runtime.control import ControlError, Handler
from agent.runtime.latest import Latest
from agent.runtime.packed_maps import packed_map

if TYPE_CHECKING:
    from agent.runtime.node import Node

CHECKPOINT_WITHIN_S = 1.0


class Orders:
    """Answers for one robot."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def commands(self) -> Mapping[str, Handler]:
        return {
            "status": lambda _: {"status": self._node.keeper.status()},
            "pause": lambda _: self._pause(True),
            "resume": lambda _: self._pause(False),
            "reset": lambda _: self._reset(),
            "unmerge": lambda request: self._order("unmerge", request),
            "readmit": lambda request: self._order("readmit", request),
            "save": lambda _: self._save(),
            "map": self._map,
            "stop": lambda _: self._stop(),
        }

    def _pause(self, is_paused: bool) -> Mapping[str, Any]:
        self._node.map.is_paused = is_paused
        return {"message": "mapping is paused" if is_paused else "mapping goes on"}

    def _reset(self) -> Mapping[str, Any]:
        self._node.reset_map()
        return {"message": "a new local map begins; the old one is forgotten"}

    def _order(self, verb: str, request: Mapping[str, Any]) -> Mapping[str, Any]:
        peer = request.get("peer")
        known = [peer.robot for peer in self._node.fleet.state().peers]
        if not isinstance(peer, str) or peer not in known:
            raise ControlError(f"no peer {peer!r}; known are {', '.join(known) or 'none yet'}")
        self._node.fleet.order(verb, peer)
        return {"message": f"{peer} is taken out of our map until readmit" if verb == "unmerge" else f"{peer} may merge again"}

    def _save(self) -> Mapping[str, Any]:
        node = self._node
        if node.state is None:
            raise ControlError("this agent keeps no state: it was started without a state directory")
        made: Latest[bytes] = Latest()  # of our own: the keeper would take one that lies in its own
        node.map.call(lambda: made.put(node.map.mapper.checkpoint()))
        checkpoint = made.take(CHECKPOINT_WITHIN_S)
        if checkpoint is None:
            raise ControlError("the mapper did not answer in time; try again")
        if not node.state.save("mapper", checkpoint):
            raise ControlError(f"not saved: {node.state.last_error}")
        return {"message": f"saved {len(checkpoint)} bytes in {node.state.folder}"}

    def _map(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        """The cells of a map: "global", our own, or a peer's; see `packed_maps`."""
        found = self._node.keeper.grid(str(request.get("name", snapshots.GLOBAL)))
        if found is None:
            raise ControlError(f"no map {request.get('name')!r}; there are {', '.join(snapshots.maps(self._node)) or 'none yet'}")
        version, grid = found
        return {"map": packed_map(version, grid)}

    def _stop(self) -> Mapping[str, Any]:
        self._node.stopping.set()
        return {"message": "stopping"}
