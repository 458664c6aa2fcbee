"""ROS domains for tests: each is used by one graph of this machine at a time."""

from __future__ import annotations

import fcntl
import random
import tempfile
from pathlib import Path
from typing import IO

#: Above the users' graphs (0 and what a person would choose by hand), and below 102: else DDS'
#: ports reach into the range of passing connections.
DOMAINS = range(30, 100)


class ReservedDomain:
    """A ROS domain that no other test of this machine uses until it is released.

    Domains are drawn at random, so that one is not used again as soon as it is free: a process
    of the graph before may still be on its way out.
    """

    def __init__(self) -> None:
        # The order matters to nobody, so no seed; os.urandom keeps forked workers apart.
        for domain in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
            if file := _locked(domain):
                self.number, self._file = domain, file
                return
        raise RuntimeError(f"all test domains {DOMAINS} are taken")

    def release(self) -> None:
        """Give the domain back; again is fine."""
        self._file.close()


def _locked(domain: int) -> IO[str] | None:
    file = (Path(tempfile.gettempdir()) / f"slrig-test-domain-{domain}.lock").open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file
