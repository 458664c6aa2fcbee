"""Why the emulated DLPC900 says no: TI's error codes (command 0x0100)."""

from __future__ import annotations

NO_ERROR, INVALID_COMMAND, WRONG_MODE, INVALID_PARAMETER, NOT_PRESENT = 0, 3, 5, 6, 7
BAD_BIT, BAD_DARK, BAD_DELAY, BAD_EXPOSURE, BAD_INDEX, BAD_DEFINITION = 10, 12, 13, 14, 15, 16

_ERROR_TEXTS = {
    INVALID_COMMAND: "Invalid command number",
    WRONG_MODE: "Command not allowed in current mode",
    INVALID_PARAMETER: "Invalid command parameter",
    NOT_PRESENT: "Item referred by the parameter is not present",
    BAD_BIT: "Pattern bit number out of range",
    BAD_DARK: "Pattern dark time out of range",
    BAD_DELAY: "Signal delay out of range",
    BAD_EXPOSURE: "Pattern exposure out of range",
    BAD_INDEX: "Pattern number out of range",
    BAD_DEFINITION: "Invalid pattern definition",
}


class Refusal(Exception):
    """A command that the controller answers with NACK, and its error code."""

    def __init__(self, code: int, reason: str = "") -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason or _ERROR_TEXTS.get(code, "Device failure")
