"""What a query on our subtree is answered: everything we hold that others may pull."""

from __future__ import annotations

import re

from agent.fleet.composition import Composition
from agent.fleet.estates import Estates
from agent.fleet.ledger import Ledger
from agent.fleet.own_words import OwnWords
from protocol.codec import encode
from protocol.messages import NO_DIGEST, GlobalTiles
from protocol.tiles import TileDelta

_DIGEST = re.compile(r"-|[0-9a-f]{32}")


class Registers:
    """Answers by key, as `protocol.channels` lays them out."""

    def __init__(self, ledger: Ledger, words: OwnWords, composition: Composition, estates: Estates) -> None:
        self._ledger, self._words, self._composition, self._estates = ledger, words, composition, estates

    def answer(self, key: str) -> bytes | None:
        """The encoded answer to a query on our subtree, at most 16 KB; None: there is no such register."""
        own, answers = self._ledger.own, self._ledger.own.answers
        match key.split("/"):
            case ["hello"]:
                return encode(self._words.hello())
            case ["map", "feat"]:
                return encode(own.announcement) if own.announcement else None
            case ["map", "coarse"]:
                coarse = own.coarse()
                return answers.to(coarse) if coarse else None
            case ["map", "fine", base, target] if _DIGEST.fullmatch(base) and _DIGEST.fullmatch(target):
                return own.fine(_digest(base), _digest(target))
            case ["edge", other]:
                statement = self._ledger.mine.get(other)
                return encode(statement) if statement else None
            case ["edges"]:
                return answers.to(self._words.statements())
            case ["global", "meta"]:
                return answers.to(self._composition.meta) if self._composition.meta else None
            case ["global", "tiles", base, target] if _DIGEST.fullmatch(base) and _DIGEST.fullmatch(target):
                return self._global_tiles(_digest(base), _digest(target))
            case ["estate", gone, digest] if _DIGEST.fullmatch(digest):
                estate = self._estates.of(gone, _digest(digest))
                return answers.to(estate) if estate else None
            case ["blob", digest, index] if re.fullmatch(r"[0-9a-f]{64}", digest) and re.fullmatch(r"\d{1,5}", index):
                return answers.chunk(bytes.fromhex(digest), int(index))
        return None

    def _global_tiles(self, base: bytes, target: bytes) -> bytes | None:
        """The difference between two global maps we hold; from nothing when the base is not remembered."""
        ledger, history = self._ledger, self._composition.history
        wanted, old = history.get(target) if target else history.newest, history.get(base)
        if wanted is None:
            return None
        name = ("global", old.digest if old else NO_DIGEST, wanted.digest)
        return ledger.own.answers.kept(name, lambda: GlobalTiles(ledger.robot, ledger.boot, TileDelta.between(old, wanted)))


def _digest(text: str) -> bytes:
    return NO_DIGEST if text == "-" else bytes.fromhex(text)
