"""What can go wrong with words.

ProtocolError
  LocalProtocolError     we tried to send nonsense: a bug of ours
  RemoteProtocolError    a peer (or a file) did: dropped and counted
    NewerPeer            it speaks a major version we do not know
    TooLarge             it claims more than a limit allows
"""

from __future__ import annotations


class ProtocolError(Exception):
    """Root of everything this room raises."""


class LocalProtocolError(ProtocolError):
    """This program tried to encode something that may not travel."""


class RemoteProtocolError(ProtocolError):
    """Bytes from outside are not a valid message."""


class NewerPeer(RemoteProtocolError):
    """The peer speaks a newer major version of the protocol."""


class TooLarge(RemoteProtocolError):
    """The bytes claim more than the limits of this protocol allow."""
