"""The user's code, called so that whatever it does harms nothing but itself.

It may end the program (`SystemExit`), raise what is no `Exception` or what can't be printed, and
change the working directory, to which paths of the command line are relative.
"""

from __future__ import annotations

import os
from contextlib import suppress
from types import TracebackType

from grounded.errors import GroundedError


class contained:
    """A context for a call of the user's code.

    What is raised in it leaves it as an `Exception` of the same name whose text can be read; only
    Ctrl-C stays what it is. The working directory is the same afterwards.
    """

    def __enter__(self) -> None:
        try:
            self.folder = os.getcwd()  # noqa: PTH109 (called at every step of a black box)
        except OSError:  # it was deleted
            self.folder = ""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with suppress(OSError):
            if self.folder and os.getcwd() != self.folder:  # noqa: PTH109
                os.chdir(self.folder)
        if kind is None or isinstance(error, KeyboardInterrupt | GroundedError):
            return
        try:
            text, plain = str(error), isinstance(error, Exception)
        except BaseException:  # its __str__ is the user's code, too
            text, plain = "its text can't be read", False
        if not plain:
            raise type(kind.__name__, (Exception,), {})(text).with_traceback(trace) from None
