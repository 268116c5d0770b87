"""The one global map of a group: a pure function of which maps lie where.

The smallest live robot of a group composes: it picks one version of every member's map and one transform each, fuses,
and publishes the recipe.  Everybody else holds the same maps, follows the recipe and compares digests, so nobody has to be
believed.  Groups too large for every robot to hold every map take the cells from the composer instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from agent.fleet.effects import Changed, Fuse
from agent.fleet.frame_graph import Group
from agent.fleet.ledger import Ledger
from agent.fleet.own_map import History
from agent.fleet.state import Presence
from protocol.channels import MAX_PUSH_BYTES
from protocol.codec import encode
from protocol.geometry import SE2, wrap_angle
from protocol.grid import OccupancyGrid
from protocol.messages import NO_DIGEST, GlobalMap, GlobalMember, GlobalMeta, GlobalTiles, MapVersion
from protocol.tiles import TileMap

_KEPT_GLOBAL_MAPS = 6
_FOLLOW_M, _FOLLOW_RAD = 0.4, 0.06  # how far a composer's layout may be from ours and still be followed
_RECIPE_WAIT_S = 2.5
_FUSING_SHARE = 4.0  # a pause of this many times what the last fusion took: large groups on slow machines compose less often
_PATIENCE_S = 10.0  # without a usable recipe for this long, each makes its own

MissingMap = tuple[str, bytes]  # (robot, digest) that a recipe needs


class Fused(Protocol):
    """What is used of `agent.merging.FusedMap`."""

    @property
    def grid(self) -> OccupancyGrid: ...
    @property
    def conflicting_cells(self) -> int: ...
    @property
    def agreeing_cells(self) -> int: ...


@dataclass(frozen=True, slots=True)
class _Recipe:
    root: str
    resolution_m: float
    members: tuple[GlobalMember, ...]
    edges: tuple[bytes, ...]
    followed: GlobalMeta | None  # None: our own

    def inputs(self) -> tuple[object, ...]:
        """All that decides the cells."""
        return self.resolution_m, [(m.robot, m.map.frame, m.map.digest, m.T_global_map) for m in self.members]


class Composition:
    """Keeps the global map this robot holds up to date."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.history = History(_KEPT_GLOBAL_MAPS)
        self.global_map: GlobalMap | None = None
        self.meta: GlobalMeta | None = None  # what we published last
        self.root = ledger.robot
        self.composer = ledger.robot
        self._made: _Recipe | None = None  # what `global_map` was made from
        self._running: tuple[int, _Recipe, float] | None = None
        self._composed_s = -1e9
        self._fusing_took_s = 0.0
        self._grouped_s: float | None = None  # since when we are not alone
        self._followed_s: float | None = None  # since when there was a usable recipe, or we began to wait for one
        self._seq = 0

    def step(self, now_s: float) -> list[MissingMap]:
        """Make the next global map when its inputs changed; the maps that are missing for it."""
        group = self._ledger.group
        if group is None:
            self._be_alone()
            return []
        self.composer = self._composer_of(group)
        if self._running is not None and now_s - self._running[2] < self._ledger.options.fetch_timeout_s:
            return []
        if self.composer == self._ledger.robot:
            return self._compose(group, now_s)
        return self._follow(group, now_s)

    def wanted_tiles(self) -> tuple[str, bytes] | None:
        """(composer, digest) of a global map that is pulled instead of made."""
        meta = self._recipe_of_composer()
        if meta is None or len(meta.members) <= self._ledger.options.max_held_maps or self.composer == self._ledger.robot:
            return None
        if self.global_map is not None and self.global_map.digest == meta.digest:
            return None
        return self.composer, meta.digest

    def on_tiles(self, said: GlobalTiles) -> None:
        """Cells of the global map came from the composer."""
        meta = self._recipe_of_composer()
        if meta is None or said.robot != self.composer or said.delta.digest != meta.digest:
            return
        base = self.history.get(said.delta.base_digest) if said.delta.base_digest else None
        tiles = said.delta.apply(base)
        recipe = _Recipe(meta.root, meta.resolution_m, meta.members, meta.edges, meta)
        self._adopt(recipe, tiles, meta.conflicting_cells, meta.agreeing_cells)

    def on_fused(self, job: Fuse, fused: Fused | None, now_s: float) -> None:
        if self._running is None or self._running[0] != job.id:
            return
        self._fusing_took_s = now_s - self._running[2]
        recipe, self._running = self._running[1], None
        if fused is None or self._ledger.group is None:
            return
        tiles = TileMap.of(fused.grid)
        if recipe.followed is not None and tiles.digest != recipe.followed.digest:
            self._ledger.note("global-map-differs", is_warning=True, composer=recipe.followed.robot)
        self._adopt(recipe, tiles, fused.conflicting_cells, fused.agreeing_cells)

    # Whose turn it is.

    def _composer_of(self, group: Group) -> str:
        """The smallest robot that is there; a frozen map composes only among frozen maps."""
        here = [robot for robot in group.T_root if self._is_here(robot)]
        moving = [robot for robot in here if not self._is_frozen(robot)]
        return min(moving or here or [self._ledger.robot])

    def _is_here(self, robot: str) -> bool:
        return robot == self._ledger.robot or self._ledger.peers[robot].presence is not Presence.LOST

    def _is_frozen(self, robot: str) -> bool:
        return self._ledger.options.is_frozen if robot == self._ledger.robot else self._ledger.peers[robot].is_frozen

    def _root_of(self, group: Group) -> str:
        """Whose frame is the global one: a given map's, else the one it was, else the smallest robot's.

        When groups meet, the frame of the larger one stays: fewer robots see their map jump.
        """
        frozen = [robot for robot in group.T_root if self._is_frozen(robot)]
        if frozen:
            return self.root if self.root in frozen else min(frozen)
        known = [(len(meta.members), meta.root) for meta in self._metas_of(group) if meta.root in group.T_root]
        largest, root = max(known, key=lambda pair: pair[0], default=(0, min(group.T_root)))
        if self.global_map is not None and self.root in group.T_root and largest <= len(self.global_map.members):
            return self.root
        return root

    def _metas_of(self, group: Group) -> list[GlobalMeta]:
        """Recipes that members of the group published, of maps that some member still holds."""
        peers = [self._ledger.peers[robot] for robot in sorted(group.T_root) if robot in self._ledger.peers]
        held = {peer.beat.global_digest for peer in peers if peer.beat is not None}
        return [peer.meta for peer in peers if peer.meta is not None and peer.meta_id in held]

    def awaits_meta(self, robot: str) -> bool:
        """Whether a peer of our group holds a global map whose frame we should know before we make our own.

        What the composer, or anybody who holds the same map, told us of it is enough.
        """
        group, peer = self._ledger.group, self._ledger.peers.get(robot)
        if self.global_map is not None or group is None or robot not in group.T_root or peer is None or peer.beat is None:
            return False
        asked = peer.beat.global_digest
        return asked != NO_DIGEST and all(other.meta_id != asked for other in self._ledger.peers.values())

    # Composing.

    def _compose(self, group: Group, now_s: float) -> list[MissingMap]:
        missing: list[MissingMap] = []
        versions = {self._ledger.robot: self._ledger.own.version}
        for robot in group.T_root:
            peer = self._ledger.peers.get(robot)
            if peer is not None:
                versions[robot] = peer.admitted
                if peer.map is not None and peer.map != peer.held:
                    missing.append((robot, b""))
        if self._waits_for_recipes(group, now_s):
            return missing
        if now_s - self._composed_s >= self._pause_s(group):
            self._composed_s = now_s
            recipe = self._recipe(group, {robot: version for robot, version in versions.items() if version is not None})
            if recipe is not None and recipe != self._made:
                self._fuse(recipe, now_s)
        return missing

    def _pause_s(self, group: Group) -> float:
        """Who belongs to us is told soon; how the maps grow the less often the more we are, since each of us lays all of them."""
        options, period_s = self._ledger.options, self._ledger.options.compose_period_s
        if self._made is not None and {member.robot for member in self._made.members} == group.T_root.keys():
            period_s = max(period_s, options.compose_s_a_member * len(group.T_root))
        return max(period_s, _FUSING_SHARE * self._fusing_took_s)

    def _waits_for_recipes(self, group: Group, now_s: float) -> bool:
        """A newcomer first asks which frame the others share already; not for long."""
        if self.global_map is not None:
            return False
        if self._grouped_s is None:
            self._grouped_s = now_s
        holds_any = any(self.awaits_meta(robot) for robot in group.T_root)
        return holds_any and not self._metas_of(group) and now_s - self._grouped_s < _RECIPE_WAIT_S

    def _recipe(self, group: Group, versions: dict[str, MapVersion]) -> _Recipe | None:
        """The group's layout with these versions; None while there are fewer than two whose cells are here."""
        seen = group.rerooted(self._root_of(group))
        members = tuple(
            GlobalMember(robot, versions[robot], _rounded(T), seen.covariance[robot])
            for robot, T in sorted(seen.T_root.items())
            if robot in versions
            and self._grid(robot, versions[robot].digest) is not None
            and versions[robot].frame == self._ledger.frame_of(robot)
        )
        names = {member.robot for member in members}
        if len(members) < 2 or self._ledger.robot not in names:
            return None
        root = seen.root
        if root not in names:  # its cells are not here yet: anyone's frame will do until they are
            root = min(names)
            T_new_old = next(m.T_global_map for m in members if m.robot == root).inverse()
            members = tuple(GlobalMember(m.robot, m.map, _rounded(T_new_old @ m.T_global_map), m.covariance) for m in members)
        grids = [self._tiles(member.robot, member.map.digest) for member in members]
        resolution_m = min(tiles.resolution_m for tiles in grids if tiles is not None)
        return _Recipe(root, resolution_m, members, tuple(sorted(edge.id for edge in group.edges)), None)

    def _publish(self, recipe: _Recipe, digest: bytes, conflicting_cells: int, agreeing_cells: int) -> None:
        """Tell the recipe of the map we hold, even one we followed: its author may be gone.  Composers push it."""
        self._seq += 1
        ledger = self._ledger
        self.meta = GlobalMeta(
            ledger.robot,
            ledger.boot,
            self._seq,
            recipe.root,
            recipe.resolution_m,
            recipe.members,
            recipe.edges,
            digest,
            conflicting_cells,
            agreeing_cells,
        )
        if self.composer == ledger.robot and len(encode(self.meta)) <= MAX_PUSH_BYTES:
            ledger.send(self.meta)

    # Following.

    def _follow(self, group: Group, now_s: float) -> list[MissingMap]:
        meta = self._recipe_of_composer()
        if self._followed_s is None:
            self._followed_s = now_s
        if meta is None or not self._is_credible(meta, group):
            return self._compose(group, now_s) if now_s - self._followed_s > _PATIENCE_S else []
        self._followed_s = now_s
        if len(meta.members) > self._ledger.options.max_held_maps:
            return []
        recipe = _Recipe(meta.root, meta.resolution_m, meta.members, meta.edges, meta)
        if self._made is not None and self._made.members == meta.members and self._made.root == meta.root:
            return []
        missing = [(m.robot, m.map.digest) for m in meta.members if self._tiles(m.robot, m.map.digest) is None]
        if not missing:
            self._fuse(recipe, now_s)
        return [(robot, digest) for robot, digest in missing if robot != self._ledger.robot]

    def _recipe_of_composer(self) -> GlobalMeta | None:
        peer = self._ledger.peers.get(self.composer)
        return peer.meta if peer else None

    def _is_credible(self, meta: GlobalMeta, group: Group) -> bool:
        """Whether a recipe says what our own edges say: only members of our group, each about where we have it."""
        names = {member.robot for member in meta.members}
        if self._ledger.robot not in names or not names <= group.T_root.keys() or meta.root not in names:
            return False
        T_root = group.rerooted(meta.root).T_root
        for member in meta.members:
            T, ours = member.T_global_map, T_root[member.robot]
            if member.map.frame != self._ledger.frame_of(member.robot):
                return False
            peer = self._ledger.peers.get(member.robot)
            if peer is not None and member.map.digest in peer.refused:
                return False
            if T.distance_m(ours) > _FOLLOW_M or abs(wrap_angle(T.theta_rad - ours.theta_rad)) > _FOLLOW_RAD:
                return False
        return True

    # Both.

    def _fuse(self, recipe: _Recipe, now_s: float) -> None:
        """Have the recipe's maps laid over one another; when only words about them changed, the map we hold is that map."""
        held, tiles = self.global_map, self.history.newest
        if held is not None and tiles is not None and self._made is not None and self._made.inputs() == recipe.inputs():
            self._adopt(recipe, tiles, held.conflicting_cells, held.agreeing_cells)
            return
        maps = []
        for member in recipe.members:
            grid = self._grid(member.robot, member.map.digest)
            assert grid is not None
            maps.append((grid, member.T_global_map))
        job = Fuse(self._ledger.new_id(), tuple(maps), recipe.resolution_m)
        self._running = (job.id, recipe, now_s)
        self._ledger.effects.append(job)

    def _adopt(self, recipe: _Recipe, tiles: TileMap, conflicting_cells: int, agreeing_cells: int) -> None:
        self.history.add(tiles)
        self._made, self.root = recipe, recipe.root
        self._publish(recipe, tiles.digest, conflicting_cells, agreeing_cells)
        author = recipe.followed.robot if recipe.followed else self._ledger.robot
        self.global_map = GlobalMap(
            author, recipe.root, tiles.digest, recipe.members, tiles.grid(), conflicting_cells, agreeing_cells
        )
        self._ledger.effects.append(Changed(self.global_map))

    def _be_alone(self) -> None:
        self.composer = self.root = self._ledger.robot
        self._followed_s = self._grouped_s = self._made = self._running = self.meta = None
        if self.global_map is not None:
            self.global_map = None
            self.history = History(_KEPT_GLOBAL_MAPS)
            self._ledger.effects.append(Changed(None))

    def _tiles(self, robot: str, digest: bytes) -> TileMap | None:
        if robot == self._ledger.robot:
            return self._ledger.own.version_tiles(digest)
        peer = self._ledger.peers.get(robot)
        return peer.maps.get(digest) if peer else None

    def _grid(self, robot: str, digest: bytes) -> OccupancyGrid | None:
        tiles = self._tiles(robot, digest)
        own, peer = self._ledger.own, self._ledger.peers.get(robot)
        if tiles is None:
            return None
        if robot == own.robot and own.version is not None and own.version.digest == digest:
            return own.grid
        if peer is not None and peer.held is not None and peer.held.digest == digest:
            return peer.grid
        return tiles.grid()


def _rounded(T: SE2) -> SE2:
    """To a micrometre: the recipe travels, so it need not be longer than it is precise."""
    return SE2(round(T.x_m, 6) + 0.0, round(T.y_m, 6) + 0.0, wrap_angle(round(T.theta_rad, 7)) + 0.0)
