"""A process that makes an object and calls its methods, one at a time."""

import os
import signal
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, NamedTuple


class WorkerError(RuntimeError):
    """A worker process failed or died; the message names it."""


class _Message(NamedTuple):
    """A part of an answer; the last one of each answer is marked."""

    failure: str | None = None
    content: Any = None
    is_last: bool = True


class Worker:
    """The caller's side of a process.

    Args:
        context: of multiprocessing.
        make: picklable; called in the process, returns the object whose methods are called. Its
            `close` is called at the end.
        name: what the process holds, in words.
    """

    def __init__(self, context: Any, make: Callable[[], Any], name: str) -> None:
        """Starts the process; its first answer is the file of the code it runs."""
        self.name = name
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, make), daemon=True)
        self.process.start()
        theirs.close()
        self.owes_answer = True

    def send(self, method: str, arguments: tuple[Any, ...]) -> None:
        """Calls a method, after dropping what was not received of the answer before."""
        while self.owes_answer:
            self.receive()
        try:
            self.pipe.send((method, arguments))
            self.owes_answer = True
        except OSError as error:
            raise self._gone() from error

    def receive(self) -> Any:
        """Waits for the next part of the answer.

        That is what the method returned, or what it yielded, with None as the last part.
        """
        try:
            message: _Message = self.pipe.recv()
            self.owes_answer = not message.is_last
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if message.failure is not None:
            raise WorkerError(f"the worker process of {self.name} failed:\n{message.failure}")
        return message.content

    def end(self) -> None:
        """Waits briefly for the process to notice that its pipe is closed."""
        self.process.join(timeout=5.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()

    def _gone(self) -> WorkerError:
        self.process.join(timeout=1.0)
        code = self.process.exitcode
        reason = f"exit code {code}"
        if code is not None and code < 0:
            reason = signal.Signals(-code).name
        return WorkerError(
            f"the worker process of {self.name} is gone ({reason}): perhaps the system killed it "
            "for want of memory, or the script that defines its environments lacks an "
            '`if __name__ == "__main__":`'
        )


def _work(pipe: Connection, make: Callable[[], Any]) -> None:
    """Calls methods until the other end of the pipe is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    made = None
    try:
        made = make()
        _answer(pipe, os.path.realpath(__file__))
        while True:
            method, arguments = pipe.recv()
            _answer(pipe, getattr(made, method)(*arguments))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the caller has closed, or is gone
    except Exception:
        pipe.send(_Message(failure=traceback.format_exc()))
    finally:
        if made is not None:
            made.close()


def _answer(pipe: Connection, result: Any) -> None:
    if isinstance(result, Iterator):
        for item in result:
            pipe.send(_Message(content=item, is_last=False))
        result = None
    pipe.send(_Message(content=result))
