"""How the fleet logic behaves; each default is a decision with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """Times in seconds of the local monotonic clock; no time of a peer is ever compared with ours."""

    is_frozen: bool = False  # this coordinator speaks for a given map: it never grows, never moves, roots its group
    beat_period_s: float = 1.0  # loss of one hint heals within about this
    beat_jitter: float = 0.2  # share of the period; keeps a fleet from beating in step
    max_beats_per_s: float = 40.0  # larger fleets beat slower, so that a robot never hears more than this
    suspect_after_beats: float = 4.0
    lost_after_s: float = 15.0  # network stalls of 10 s are normal and mean nothing
    announce_period_s: float = 2.0  # a growing map is published at most this often; beats carry its version
    announce_growth: float = 0.10  # and its features are sent again when it has grown by this share
    compose_period_s: float = 2.0  # the global map is composed at most this often
    compose_s_a_member: float = 0.4  # and while nobody comes or goes at most this often: the work of a group of 20 is that of 5
    fetch_timeout_s: float = 40.0  # a runtime that never answers a Fetch is not waited for longer
    max_bulk_fetches: int = 2  # more only share the same radio
    max_small_fetches: int = 8
    retry_growth: float = 0.10  # a pair that did not fit is tried again when a map has grown by this share
    retry_period_s: float = 3.0  # and not sooner than this
    retry_change_s: float = 20.0  # a pair whose maps changed without growing is tried again after this long
    reverify_growth: float = 0.05  # a live edge is checked again when a map has grown by this share
    reverify_period_s: float = 3.0
    renew_growth: float = 0.30  # a live edge is proposed anew, with better figures, when the overlap has grown by this
    coarse_hopeful_score: float = 4.0  # metres of agreeing wall at 20 cm below which the fine map is not pulled at once
    coarse_skip_bytes: int = 8_192  # a fine map this small is pulled at once: the coarse one costs as much
    strangers_at_once: int = 32  # robots whose maps are pulled without waiting, and then this many a minute:
    strangers_per_minute: float = 30.0  # what a fleet of any size may cost in pulled maps
    max_edges: int = 6  # per robot: enough loops to find a wrong edge, few enough to keep verified
    max_held_maps: int = 24  # larger groups take the global map from its composer instead of every member's map
    max_peers: int = 1_024  # a fleet of a thousand; a table full of strangers that announce 600 lines each costs 17 MB
    max_told: int = 64  # robots that nobody hears, taken on the word of others: as many maps are held for them
    min_match_factor: float = 0.85  # the paper's; equation (3)
    same_transform_m: float = 0.5  # two transforms of one pair are the same within these
    same_transform_rad: float = 0.06
    max_new_conflict: float = 0.10  # share of walls by which a member may contradict us more than when it joined
    max_taken_back: float = 0.004  # share of the cells another robot confirms that a member may take back; honest maps: 0.0033
    max_moved_walls: float = 0.012  # the same, walls that moved by one cell included; honest maps: 0.008
    denied_walls: float = 0.35  # share of its walls that are elsewhere in spite of two others, and hardly a piece of its earlier
    found_again: float = 0.3  # map found again anywhere near: that is no redrawing, it is another place or an invention
    held_back_s: float = 300.0  # a map held back for this long whose edges are verified all the same is believed again
    renew_period_s: float = 15.0  # a live edge whose maps changed is checked and proposed anew at least this often
    quarantine_strikes: int = 3  # provable untruths before a peer's statements are no longer heard
    quarantine_s: float = 300.0
    seed: int = 0  # of the jitter
