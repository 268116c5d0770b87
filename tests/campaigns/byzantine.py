"""C10: five robots, one of them a liar, in every way of `tests/fleet/attackers.py`.

    .venv/bin/python -m tests.campaigns.byzantine [--seeds 5] [--json FILE]

The fleet merges first; then one robot turns bad for a minute.  Measured: the share of honestly mapped cells that the liar
changes in the honest robots' global map (at the worst moment and at the end), whether honest robots stay where they truly
are and together, the time until somebody quarantines or drops the liar, and whether un-merging it gives, to the bit, the map
that the honest maps and the honest edges alone give.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from agent.fleet.frame_graph import Edge, solve
from agent.merging.fusion import fuse
from protocol.geometry import SE2
from protocol.messages import GlobalMap
from protocol.tiles import TileMap
from tests.bench.tables import markdown, write_json
from tests.fleet.attackers import ATTACKS
from tests.fleet.explorer import Explorer, random_world
from tests.fleet.lying_maps import Liar
from tests.fleet.processes import Node
from tests.fleet.simulation import Fleet

ROBOTS, ATTACK_S = 5, 60.0


@dataclass
class Verdict:
    """One attack of one seed."""

    attack: str
    seed: int
    worst_share: float  # of honest cells altered, at any moment
    final_share: float
    misplaced: int  # honest robots that stood wrong at any moment
    separated: int  # honest robots that are not together at the end
    contained_s: float | None  # until the liar is out of every honest map; None: it stayed in
    quarantined_s: float | None
    is_unmerge_exact: bool


def make_fleet(seed: int) -> Fleet:
    fleet = Fleet(seed)
    world = random_world(seed, 60.0, 0.5)
    for i in range(ROBOTS):
        angle = i * 2 * np.pi / ROBOTS
        place = SE2(9 * float(np.cos(angle)), 9 * float(np.sin(angle)), angle)
        explorer = Explorer.at(world, place, 0.9 * i)
        explorer.look(place, 12)
        fleet.add(f"r{i}", Liar.like(explorer))
    return fleet


def altered_share(held: GlobalMap, liar: str, fleet: Fleet) -> float:
    """Share of the cells that the honest members' maps give and this global map does not."""
    honest = []
    for member in held.members:
        if member.robot != liar:
            explorer = fleet.nodes[member.robot].explorer
            assert explorer is not None
            honest.append((TileMap.of(explorer.grid).grid(), member.T_global_map))
    if not honest:
        return 0.0
    expected = fuse(honest, held.grid.resolution_m).grid
    known = np.argwhere(expected.known())
    said = held.grid.values_at(expected.points_of(known))
    return float(np.mean(said != expected.cells[known[:, 0], known[:, 1]]))


def misplaced(held: GlobalMap, liar: str, fleet: Fleet) -> int:
    honest = [member for member in held.members if member.robot != liar]
    first = honest[0]
    T_first = {m.robot: first.T_global_map.inverse() @ m.T_global_map for m in honest}
    return sum(T.distance_m(fleet.true_T(first.robot, robot)) > 0.3 for robot, T in T_first.items())


def is_unmerge_exact(fleet: Fleet, honest: list[Node], liar: str) -> bool:
    """Operators take the liar out everywhere: is what remains exactly what the honest maps and edges give?"""
    for node in honest:
        assert node.coordinator is not None
        fleet.carry_out(node, node.coordinator.unmerge(liar, fleet.local_s(node)))
    fleet.run_until(lambda: fleet.agrees([node.name for node in honest]), 60.0)
    fleet.run(5.0)
    held = honest[0].global_map
    assert held is not None and honest[0].coordinator is not None
    live = [e for e in honest[0].coordinator._ledger.live.values() if liar not in (e.robot_a, e.robot_b)]
    layout = solve(Edge(e.robot_a, e.robot_b, e.T_a_b, e.covariance, e.overlap_m2 * e.match_factor, e.id()) for e in live)
    group = layout.group_of[honest[0].robot].rerooted(held.root)
    maps = []
    for name, T in sorted(group.T_root.items()):
        explorer = fleet.nodes[name].explorer
        assert explorer is not None
        rounded = SE2(round(T.x_m, 6) + 0.0, round(T.y_m, 6) + 0.0, round(T.theta_rad, 7) + 0.0)
        maps.append((TileMap.of(explorer.grid).grid(), rounded))
    expected = TileMap.of(fuse(maps, held.grid.resolution_m).grid)
    return expected.digest == held.digest and liar not in {member.robot for member in held.members}


def run_attack(name: str, seed: int) -> Verdict:
    """One liar at work."""
    fleet = make_fleet(seed)
    everyone = list(fleet.nodes)
    fleet.run_until(lambda: fleet.agrees(everyone), 60.0)
    fleet.run(5.0)
    liar = "r0" if name == "false recipes" or seed % 2 else "r3"
    bad, attack = fleet.nodes[liar], ATTACKS[name]()
    honest = [node for node in fleet.nodes.values() if node is not bad]
    attack.begin(fleet, bad)
    start_s = fleet.now_s
    worst, wrong, contained_s, quarantined_s = 0.0, 0, None, None
    while fleet.now_s - start_s < ATTACK_S:
        age_s = fleet.now_s - start_s
        attack.every_second(fleet, bad, age_s)
        fleet.run(1.0)
        held = [node.global_map for node in honest if node.global_map is not None]
        worst = max([worst, *(altered_share(m, liar, fleet) for m in held)])
        wrong = max([wrong, *(misplaced(m, liar, fleet) for m in held)])
        is_in = any(member.robot == liar for m in held for member in m.members)
        contained_s = None if is_in else contained_s if contained_s is not None else age_s + 1.0
        if quarantined_s is None and any(note.event == "quarantined" for node in honest for note in node.notes):
            quarantined_s = age_s + 1.0
    finals = [node.global_map for node in honest]
    together = {frozenset(m.robot for m in held.members) - {liar} for held in finals if held is not None}
    separated = 0 if together == {frozenset(n.robot for n in honest)} and None not in finals else len(honest)
    final = max((altered_share(m, liar, fleet) for m in finals if m is not None), default=1.0)
    return Verdict(name, seed, worst, final, wrong, separated, contained_s, quarantined_s, is_unmerge_exact(fleet, honest, liar))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--attack", choices=sorted(ATTACKS), action="append")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    verdicts = [run_attack(name, seed) for name in args.attack or ATTACKS for seed in range(args.seeds)]
    write_json(args.json, [asdict(verdict) for verdict in verdicts])
    names = dict.fromkeys(verdict.attack for verdict in verdicts)
    print(markdown([_row(name, [verdict for verdict in verdicts if verdict.attack == name]) for name in names]))
    return 0 if all(is_good(verdict) for verdict in verdicts) else 1


def _row(name: str, own: list[Verdict]) -> dict[str, object]:
    return {
        "attack": name,
        "altered: worst, at the end": f"{max(v.worst_share for v in own):.2%}, {max(v.final_share for v in own):.2%}",
        "misplaced": max(v.misplaced for v in own),
        "apart": max(v.separated for v in own),
        "liar out after": _seconds([v.contained_s for v in own]),
        "quarantined after": _seconds([v.quarantined_s for v in own]),
        "un-merge exact": f"{sum(v.is_unmerge_exact for v in own)} of {len(own)}",
    }


def is_good(verdict: Verdict) -> bool:
    """The bars: half a percent at any moment, honest robots in place and together, provable liars out within five seconds."""
    is_caught = verdict.quarantined_s is not None and verdict.quarantined_s <= 5.0
    is_harmless = verdict.worst_share <= 0.005 and not verdict.misplaced and not verdict.separated
    return is_harmless and verdict.is_unmerge_exact and (is_caught or not ATTACKS[verdict.attack].is_detectable)


def _seconds(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "never"
    text = f"{statistics.median(known):.0f} s, at most {max(known):.0f} s"
    return text if len(known) == len(values) else f"{text} ({len(known)} of {len(values)})"


if __name__ == "__main__":
    sys.exit(main())
