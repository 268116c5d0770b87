"""The one global map of a group: a pure function of which maps lie where.

The smallest live robot of a group composes: it picks one version of every member's map and one transform each, fuses,
and publishes the recipe.  Everybody else holds the same maps, follows the recipe and compares digests, so nobody has to be
believed.  Groups too large for every robot to hold every map take the cells from the composer instead.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

from agent.fleet.credibility import leaves_out, objection
from agent.fleet.effects import Changed, Fuse
from agent.fleet.frame_graph import Group
from agent.fleet.history import History
from agent.fleet.ledger import Ledger
from agent.fleet.recipe import Recipe, grid_of, tiles_of, written
from agent.fleet.succession import composer_of, holds_unknown_map, recipes_of, root_of
from agent.fleet.timetable import LONG_AGO_S
from protocol.channels import MAX_PUSH_BYTES
from protocol.codec import encode
from protocol.grid import OccupancyGrid
from protocol.messages import GlobalMap, GlobalMeta, GlobalTiles
from protocol.tiles import TileMap

_KEPT_GLOBAL_MAPS = 6
_KEPT_IDS = 32
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


class Composition:
    """Keeps the global map this robot holds up to date."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.history = History(_KEPT_GLOBAL_MAPS)
        self.global_map: GlobalMap | None = None
        self.meta: GlobalMeta | None = None  # what we published last
        self.root = ledger.robot
        self.composer = ledger.robot
        self.let_go: set[str] = set()  # robots that are gone and in no recipe of ours
        self._made: Recipe | None = None  # what `global_map` was made from
        self._running: tuple[int, Recipe, float] | None = None
        self._composed_s = LONG_AGO_S
        self._fusing_took_s: deque[float] = deque(maxlen=2)  # the last ones; a single long one is a process that was stopped
        self._grouped_s: float | None = None  # since when we are not alone
        self._followed_s: float | None = None  # since when there was a usable recipe, or we began to wait for one
        self._objection = ""  # to the composer's recipe
        self._left_out_s: float | None = None  # since when that recipe has no map of a robot that is gone
        self._known_ids: deque[bytes] = deque(maxlen=_KEPT_IDS)  # of the maps we held last
        self._seq = 0

    def step(self, now_s: float) -> list[MissingMap]:
        """Make the next global map when its inputs changed; the maps that are missing for it."""
        group = self._ledger.group
        if group is None:
            self._be_alone()
            return []
        self.composer = composer_of(self._ledger, group)
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
        self._adopt(Recipe.of(meta), tiles, meta.conflicting_cells, meta.agreeing_cells)

    def on_fused(self, job: Fuse, fused: Fused | None, now_s: float) -> None:
        if self._running is None or self._running[0] != job.id:
            return
        self._fusing_took_s.append(now_s - self._running[2])
        recipe, self._running = self._running[1], None
        if fused is None or self._ledger.group is None:
            return
        tiles = TileMap.of(fused.grid)
        if recipe.followed is not None and tiles.digest != recipe.followed.digest:
            self._ledger.note("global-map-differs", is_warning=True, composer=recipe.followed.robot)
        self._adopt(recipe, tiles, fused.conflicting_cells, fused.agreeing_cells)

    def awaits_meta(self, robot: str) -> bool:
        """Whether a peer of our group holds a global map that we should know: before we make our own, or while we are at odds.

        What the composer, or anybody who holds the same map, told us of it is enough.
        """
        ledger, group = self._ledger, self._ledger.group
        is_at_odds = self.composer == ledger.robot or bool(self._objection)
        if group is None or not (self.global_map is None or is_at_odds) or not holds_unknown_map(ledger, group, robot):
            return False
        beat = ledger.peers[robot].beat
        return beat is not None and beat.global_digest not in self._known_ids

    # Composing.

    def _compose(self, group: Group, now_s: float) -> list[MissingMap]:
        ledger = self._ledger
        peers = [ledger.peers[robot] for robot in group.T_root if robot in ledger.peers]
        missing = [(peer.robot, b"") for peer in peers if peer.map is not None and peer.map != peer.held]
        if self._waits_for_recipes(group, now_s):
            return missing
        if now_s - self._composed_s >= self._pause_s(group):
            self._composed_s = now_s
            admitted = {ledger.robot: ledger.own.version, **{peer.robot: peer.admitted for peer in peers}}
            versions = {robot: version for robot, version in admitted.items() if version is not None and robot not in self.let_go}
            recipe = written(ledger, group, root_of(ledger, group, self.global_map, self.root), versions)
            if recipe is not None and recipe != self._made:
                self._fuse(recipe, now_s)
        return missing

    def _pause_s(self, group: Group) -> float:
        """Who belongs to us is told soon; how the maps grow the less often the more we are, since each of us lays all of them."""
        options, period_s = self._ledger.options, self._ledger.options.compose_period_s
        if self._made is not None and self._made.names == group.T_root.keys():
            period_s = max(period_s, options.compose_s_a_member * len(group.T_root))
        return max(period_s, _FUSING_SHARE * min(self._fusing_took_s, default=0.0))

    def _waits_for_recipes(self, group: Group, now_s: float) -> bool:
        """A newcomer first asks which frame the others share already; not for long."""
        if self.global_map is not None:
            return False
        if self._grouped_s is None:
            self._grouped_s = now_s
        holds_any = any(self.awaits_meta(robot) for robot in group.T_root)
        return holds_any and not recipes_of(self._ledger, group) and now_s - self._grouped_s < _RECIPE_WAIT_S

    def _publish(self, recipe: Recipe, digest: bytes, conflicting_cells: int, agreeing_cells: int) -> None:
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
        self._known_ids.append(self.meta.id())
        if self.composer == ledger.robot and len(encode(self.meta)) <= MAX_PUSH_BYTES:
            ledger.send(self.meta)

    # Following.

    def _follow(self, group: Group, now_s: float) -> list[MissingMap]:
        meta = self._recipe_of_composer()
        if self._followed_s is None:
            self._followed_s = now_s
        ours = meta.member(self._ledger.robot) if meta is not None else None
        self._ledger.own.pinned = ours.map.digest if ours is not None else b""
        if meta is None or self._objects_to(meta, group):
            return self._compose(group, now_s) if now_s - self._followed_s > _PATIENCE_S else []
        if self._awaits_the_gone(meta, group, now_s):
            return []
        self._followed_s = now_s
        if len(meta.members) > self._ledger.options.max_held_maps:
            return []
        if self._made is not None and self._made.members == meta.members and self._made.root == meta.root:
            return []
        missing = [(m.robot, m.map.digest) for m in meta.members if tiles_of(self._ledger, m.robot, m.map.digest) is None]
        if not missing:
            self._fuse(Recipe.of(meta), now_s)
        return [(robot, digest) for robot, digest in missing if robot != self._ledger.robot]

    def _awaits_the_gone(self, meta: GlobalMeta, group: Group, now_s: float) -> bool:
        """A composer that never heard of a robot that is gone learns of it from the map that we go on holding; for a while."""
        if not leaves_out(self._ledger, meta, group):
            self._left_out_s = None
            return False
        self._left_out_s = now_s if self._left_out_s is None else self._left_out_s
        return now_s - self._left_out_s < _PATIENCE_S

    def _recipe_of_composer(self) -> GlobalMeta | None:
        peer = self._ledger.peers.get(self.composer)
        return peer.meta if peer else None

    def _objects_to(self, meta: GlobalMeta, group: Group) -> bool:
        said = objection(self._ledger, meta, group)
        if said and said != self._objection:
            self._ledger.note("recipe-not-followed", composer=meta.robot, reason=said)
        self._objection = said
        return bool(said)

    # Both.

    def _fuse(self, recipe: Recipe, now_s: float) -> None:
        """Have the recipe's maps laid over one another; when only words about them changed, the map we hold is that map."""
        held, tiles = self.global_map, self.history.newest
        if held is not None and tiles is not None and self._made is not None and self._made.inputs() == recipe.inputs():
            self._adopt(recipe, tiles, held.conflicting_cells, held.agreeing_cells)
            return
        maps = []
        for member in recipe.members:
            grid = grid_of(self._ledger, member.robot, member.map.digest)
            assert grid is not None
            maps.append((grid, member.T_global_map))
        job = Fuse(self._ledger.new_id(), tuple(maps), recipe.resolution_m)
        self._running = (job.id, recipe, now_s)
        self._ledger.effects.append(job)

    def _adopt(self, recipe: Recipe, tiles: TileMap, conflicting_cells: int, agreeing_cells: int) -> None:
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
        self._followed_s = self._grouped_s = self._left_out_s = self._made = self._running = self.meta = None
        self._objection = ""
        if self.global_map is not None:
            self.global_map = None
            self.history = History(_KEPT_GLOBAL_MAPS)
            self._ledger.effects.append(Changed(None))
