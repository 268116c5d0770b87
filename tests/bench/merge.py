"""Merging on the evaluation kit: how many pairs merge, how many wrongly, how exactly and how fast, beside other methods.

BENCH_DATA=/root/bench/data-2024 .venv/bin/python -m tests.bench.merge                       ours, all sets
BENCH_DATA='/root/bench/data-{seed}' .venv/bin/python -m tests.bench.merge --seeds 2024 11 12
.venv/bin/python -m tests.bench.merge --beside                            the paper's and the kit's methods too, every 6th pair
.venv/bin/python -m tests.bench.merge --adapters mapquilt paper-guarded fft             some of them
.venv/bin/python -m tests.bench.merge --json out.json

The kit is ../shared/bench (or MAPQUILT_SHARED); its README says what is in the sets and how success is judged.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.recordings import SHARED
from tests.bench.tables import markdown

REPO = Path(__file__).resolve().parents[2]
OURS = {
    "mapquilt": "agent.merging.adapter:merge",
    "paper": "agent.merging.adapter:merge_like_the_paper",
    "paper-guarded": "agent.merging.adapter:merge_guarded",
}
KIT = ("seed", "seed-guarded", "fft", "fmt")
SLOW = ("arw",)  # a random walk of up to four minutes a pair: only when asked for by name
SETS = ("main", "res20", "degraded")
BESIDE_STRIDE = 6  # an exhaustive search takes seconds a pair


def main() -> None:
    args = _arguments()
    if not (SHARED / "bench").is_dir():
        sys.exit(f"{SHARED}/bench: no evaluation kit there; set MAPQUILT_SHARED to the folder that holds bench/")
    for path in (SHARED, REPO):
        sys.path.insert(0, str(path))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(SHARED), str(REPO), os.environ.get("PYTHONPATH", "")])
    from bench import metrics, runner  # noqa: PLC0415  # type: ignore[import-not-found]

    runs = []
    for adapter in [*OURS, *KIT] if args.beside else args.adapters:
        for seed in args.seeds:
            for which in args.sets:
                folder = Path(args.data.format(seed=seed)) / which
                run = _run(runner, folder, adapter, args)
                run.update(seed=seed, wrong=[r["id"] for r in run["rows"] if r["accepted"] and not r["correct"]])
                runs.append(run)
                print(f"{adapter}, seed {seed}, {which}: {len(run['rows'])} pairs done", file=sys.stderr, flush=True)
    print(markdown([_row(run) for run in runs]))
    for by in ("log", "bin", "res", "degrade", "corridor"):
        print(f"\n### merged, right % by {by} (w: wrong merges)\n\n{metrics.matrix(runs, by)}")
    if args.json:
        slim = [{k: v for k, v in run.items() if k != "rows"} for run in runs]
        Path(args.json).write_text(json.dumps(slim, indent=1, default=float))


def _arguments() -> argparse.Namespace:
    default = os.environ.get("BENCH_DATA", str(Path.home() / ".cache/mapquilt-bench/data"))
    parser = argparse.ArgumentParser(prog="tests.bench.merge", description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("--adapters", nargs="+", default=["mapquilt"], choices=[*OURS, *KIT, *SLOW])
    parser.add_argument("--beside", action="store_true", help="every method there is, ours and the kit's, on the same pairs")
    parser.add_argument("--seeds", nargs="+", default=["2024"], help="fills {seed} in --data")
    parser.add_argument("--data", default=default, help="where the sets lie (default: BENCH_DATA)")
    parser.add_argument("--sets", nargs="+", default=list(SETS))
    parser.add_argument("--stride", type=int, help=f"every n-th pair (default 1; with --beside {BESIDE_STRIDE})")
    parser.add_argument("--timeout", type=float, default=300.0)
    parser.add_argument("--json", metavar="FILE", help="also write everything but the rows as JSON")
    return parser.parse_args()


def _run(runner: Any, folder: Path, adapter: str, args: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as scratch:
        run: dict[str, Any] = runner.run(
            str(folder),
            OURS.get(adapter, adapter),
            f"{scratch}/run.json",
            adapter,
            args.timeout,
            stride=args.stride or (BESIDE_STRIDE if args.beside else 1),
            verbose=False,
        )
    return run


def _row(run: dict[str, Any]) -> dict[str, object]:
    s, good = run["summary"], [r for r in run["rows"] if r["accepted"] and r["correct"]]

    def spread(key: str, scale: float, digits: int) -> str:
        if not good:
            return "-"
        median, worst = np.percentile([r[key] for r in good], [50, 95]) * scale
        return f"{median:.{digits}f} ({worst:.{digits}f})"

    return {
        "method": run["adapter"],
        "seed": run["seed"],
        "set": run["set"],
        "pos / neg": f"{s['pos']} / {s['neg']}",
        "merged, right %": f"**{100 * s['success']:.1f}**",
        "best hypothesis right %": f"{100 * s['hypothesis']:.1f}",
        "wrong merges": s["n_wrong"],
        "R@P100 %": f"{100 * s['recall_p100']:.1f}",
        "error median (95 %) cm": spread("err_t", 100, 1),
        "deg": spread("err_r", 1, 3),
        "CPU s median (95 %)": f"{s['cpu_med']:.2f} ({s['cpu_p95']:.2f})",
    }


if __name__ == "__main__":
    main()
