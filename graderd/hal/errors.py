"""The exception tree of everything that touches a device.

::

    DeviceError                  where it happened, why, and what to do about it
    ├── DeviceMissingError       the port, channel, camera or file is not there
    ├── WrongDeviceError         something answers, but it is not what the configuration says
    ├── DeviceLostError          it was there and is gone (cable, power, process)
    ├── DeviceTimeoutError       no (complete) answer within the deadline
    ├── ProtocolError            an answer came and is not valid
    ├── DeviceRefusedError       the device understood and said no
    ├── LifecycleError           the call is not allowed in this lifecycle state
    └── CommandRangeError        the value asked for is outside the limits
    StaleReadingError            a value exists but is older than the reader accepts, or was marked invalid
"""

from __future__ import annotations


class DeviceError(Exception):
    """A device or its wire failed.

    ``where`` names the device or path, ``cause`` says what is wrong, ``remedy`` what a person does about it;
    ``str()`` gives the three in one line.
    """

    def __init__(self, where: str, cause: str, remedy: str = "") -> None:
        super().__init__(where, cause, remedy)
        self.where = where
        self.cause = cause
        self.remedy = remedy

    def __str__(self) -> str:
        tail = f". {self.remedy}" if self.remedy else ""
        return f"{self.where}: {self.cause}{tail}"


class DeviceMissingError(DeviceError):
    """The port, channel, camera or file does not exist or cannot be opened."""


class WrongDeviceError(DeviceError):
    """Something answers, but its model, firmware or settings are not what the configuration says."""


class DeviceLostError(DeviceError):
    """The device was there and is gone: cable pulled, power cut, process ended."""


class DeviceTimeoutError(DeviceError):
    """No complete answer came within the deadline."""


class ProtocolError(DeviceError):
    """An answer came and is not valid: checksum, length, address or content."""


class DeviceRefusedError(DeviceError):
    """The device understood the request and refused it."""


class LifecycleError(DeviceError):
    """The call is not allowed in the device's present lifecycle state."""


class CommandRangeError(DeviceError):
    """The commanded value is not finite or outside the limits; nothing was sent."""


class StaleReadingError(Exception):
    """The newest reading is older than the caller accepts, or it was marked invalid."""
