"""What a global map is made of: which version of whose map, laid where; and how a robot writes one from what it holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from agent.fleet.frame_graph import Group
from agent.fleet.ledger import Ledger
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid
from protocol.messages import GlobalMember, GlobalMeta, MapVersion
from protocol.tiles import TileMap


@dataclass(frozen=True, slots=True)
class Recipe:
    """Lay exactly these maps at exactly these transforms."""

    root: str
    resolution_m: float
    members: tuple[GlobalMember, ...]
    edges: tuple[bytes, ...]
    followed: GlobalMeta | None  # None: our own

    @staticmethod
    def of(meta: GlobalMeta) -> Recipe:
        return Recipe(meta.root, meta.resolution_m, meta.members, meta.edges, meta)

    @property
    def names(self) -> set[str]:
        return {member.robot for member in self.members}

    def inputs(self) -> tuple[object, ...]:
        """All that decides the cells."""
        return self.resolution_m, [(m.robot, m.map.frame, m.map.digest, m.T_global_map) for m in self.members]


def written(ledger: Ledger, group: Group, root: str, versions: Mapping[str, MapVersion]) -> Recipe | None:
    """The group's layout with these versions; None while there are fewer than two whose cells are here."""
    seen = group.rerooted(root)
    members = tuple(
        GlobalMember(robot, versions[robot], _rounded(T), seen.covariance[robot])
        for robot, T in sorted(seen.T_root.items())
        if robot in versions
        and tiles_of(ledger, robot, versions[robot].digest) is not None
        and versions[robot].frame == ledger.frame_of(robot)
    )
    names = {member.robot for member in members}
    if len(members) < 2 or ledger.robot not in names:
        return None
    if root not in names:  # its cells are not here yet: anyone's frame will do until they are
        root = min(names)
        T_new_old = next(m.T_global_map for m in members if m.robot == root).inverse()
        members = tuple(GlobalMember(m.robot, m.map, _rounded(T_new_old @ m.T_global_map), m.covariance) for m in members)
    held = [tiles_of(ledger, member.robot, member.map.digest) for member in members]
    resolution_m = min(tiles.resolution_m for tiles in held if tiles is not None)
    return Recipe(root, resolution_m, members, tuple(sorted(edge.id for edge in group.edges)), None)


def tiles_of(ledger: Ledger, robot: str, digest: bytes) -> TileMap | None:
    """The cells of one version of a member's map, while they are here."""
    if robot == ledger.robot:
        return ledger.own.version_tiles(digest)
    peer = ledger.peers.get(robot)
    return peer.maps.get(digest) if peer else None


def grid_of(ledger: Ledger, robot: str, digest: bytes) -> OccupancyGrid | None:
    """The same as a grid, which the newest version of everybody is already."""
    own, peer = ledger.own, ledger.peers.get(robot)
    if robot == own.robot and own.version is not None and own.version.digest == digest:
        return own.grid
    if peer is not None and peer.held is not None and peer.held.digest == digest:
        return peer.grid
    tiles = tiles_of(ledger, robot, digest)
    return tiles.grid() if tiles is not None else None


def _rounded(T: SE2) -> SE2:
    """To a micrometre: the recipe travels, so it need not be longer than it is precise."""
    return SE2(round(T.x_m, 6) + 0.0, round(T.y_m, 6) + 0.0, wrap_angle(round(T.theta_rad, 7)) + 0.0)
