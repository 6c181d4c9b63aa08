"""Worker processes whose training may be interrupted at any time."""

from __future__ import annotations

import contextlib

from stable_baselines3.common.vec_env import SubprocVecEnv

__all__ = ["WorkersVecEnv"]


class WorkersVecEnv(SubprocVecEnv):
    """
    ``SubprocVecEnv`` that also closes after Ctrl-C has come between the answers of two workers.

    SB3's own then waits for an answer that it has read already, and never ends.
    """

    def close(self) -> None:
        """Let the workers close their environments and end. A second call does nothing."""
        if self.closed:
            return
        for remote in self.remotes:
            with contextlib.suppress(OSError):  # of a worker that has ended
                remote.send(("close", None))
        for remote in self.remotes:
            # Some workers still owe an answer, others do not; all of them end what they send.
            with contextlib.suppress(EOFError, OSError):
                while True:
                    remote.recv_bytes()
        for process in self.processes:
            process.join()
        for remote in self.remotes:
            remote.close()
        self.closed = True
