"""Every error specshield raises, as one tree.

SpecshieldError
├── InputError                  what the caller gave is wrong; nothing was changed
│   ├── FormulaError            STL text that does not parse, or has names that are not declared
│   │   └── HorizonError        a horizon over the limit
│   ├── FragmentError           a formula of a form that the policy's method or look-ahead does not take
│   ├── SampleError             samples or signals that are missing, too short, NaN or infinite
│   ├── MapError                a map, house or region that cannot be read
│   ├── RobotError              an unknown or impossible robot
│   ├── PoseError               a pose outside the map, in collision, or not finite
│   ├── LogitsError             wrong number, NaN, +inf or all null
│   ├── PolicyError             weights or a card that do not fit their task
│   ├── InfeasibleStart         no way to keep the rule was found from the initial pose
│   ├── InfeasibleSwitch        no way to keep the new rule was found from the robot's pose
│   ├── Unsupported             something that cannot be had on this server or for this task
│   ├── TooExpensive            a request that took more time or memory than one request may take
│   ├── HeadersTooLarge         request headers over the limit
│   ├── BodyTooLarge            a request body over the limit
│   └── UnsupportedMediaType    a body that is not declared as a type that is taken
├── NotFound                    no such map, policy, session or page
├── MethodNotAllowed            the page is there, the method is not
├── SessionDamaged              what was stored of the session can no longer be read
├── Conflict                    the request disagrees with what is stored
│   ├── HistoryGap              poses that do not join what the server has (`expected_t`)
│   ├── HistoryConflict         poses that overlap the stored ones and differ
│   ├── StepConflict            a step already decided, sent again with other content
│   ├── SessionFinished         a step after the end
│   ├── SessionExists           a session id already taken
│   ├── NameTaken               a name that another map or policy has
│   └── InUse                   a policy or map that is still used
├── Unauthorized                a missing or wrong API key
├── CrossSite                   a request that a page of another origin made
├── MisdirectedRequest          a Host that is not this server's
├── LimitReached                too many maps, policies, sessions or the like; delete some
│   └── RateLimited             too many requests a second for this key; ask again after Retry-After
├── InsufficientStorage         no room on the disk, or none left for this owner
├── Busy                        the server has too much to do just now; ask again after Retry-After
├── RequestTimeout              the request took too long to arrive
├── TrainingUnavailable         no worker is there to train
├── Starting                    the server is not ready yet; ask again after Retry-After
├── Stopping                    the server is about to stop; until then it still does what it is asked
├── StoreError                  the trajectory store cannot be reached
├── ServerError                 the server failed; what it knows is in its log
└── TransportError              the client could not reach the server
    └── TransportTimeout        no answer in time

`type` is the stable word that a problem document (RFC 9457) carries; `details` its extra members.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, ClassVar

SHOWN = 200  # characters of a value that was got, as `str` of an error shows it


class SpecshieldError(Exception):
    """Base of the tree. `path` names the field at fault, `got` what it held, `expected` what is valid.

    `str` tells all of them: "footprint.radius: not a number in range; got -1; expected above 0".
    """

    type: ClassVar[str] = "error"

    def __init_subclass__(cls, type: str | None = None) -> None:
        super().__init_subclass__()
        cls.type = type or cls.type

    def __init__(
        self,
        message: str,
        *,
        path: str | None = None,
        got: Any = None,
        expected: str | None = None,
        **details: Any,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.path = path
        self.got = got
        self.expected = expected
        self.details: dict[str, Any] = details

    def __str__(self) -> str:
        told = re.search(rf"(?<![\w.]){re.escape(self.path or '')}(?![\w.]*\w)", self.message)
        where = f"{self.path}: " if self.path and not told else ""
        shown = "" if self.got is None else repr(self.got)
        got = f"; got {shown if len(shown) <= SHOWN else shown[:SHOWN] + '…'}" if shown else ""
        expected = f"; expected {self.expected}" if self.expected else ""
        message = self.message.removesuffix(expected)  # some messages say it already
        return f"{where}{message}{got}{expected}"

    def retold(self, message: str, **details: Any) -> SpecshieldError:
        """The same error in other words, and with these details."""
        return type(self)(message, path=self.path, got=self.got, expected=self.expected, **details)

    def at(self, path: str) -> SpecshieldError:
        """The same error, its path put below `path`: 'formula' at 'spec' is 'spec.formula'."""
        self.path = path if self.path is None else f"{path}.{self.path}"
        return self


class InputError(SpecshieldError, type="invalid-input"): ...


class FormulaError(InputError, type="invalid-formula"):
    """`position` (0-based offset into the text) is in `details`."""


class HorizonError(FormulaError, type="horizon-too-long"): ...


class FragmentError(InputError, type="outside-fragment"): ...


class SampleError(InputError, type="invalid-samples"): ...


class MapError(InputError, type="invalid-map"): ...


class RobotError(InputError, type="invalid-robot"): ...


class PoseError(InputError, type="invalid-pose"): ...


class LogitsError(InputError, type="invalid-logits"): ...


class PolicyError(InputError, type="invalid-policy"): ...


class InfeasibleStart(InputError, type="infeasible-start"): ...


class InfeasibleSwitch(InputError, type="infeasible-switch"): ...


class Unsupported(InputError, type="unsupported"): ...


class TooExpensive(InputError, type="too-expensive"): ...


class HeadersTooLarge(InputError, type="headers-too-large"): ...


class BodyTooLarge(InputError, type="body-too-large"): ...


class UnsupportedMediaType(InputError, type="unsupported-media-type"): ...


class NotFound(SpecshieldError, type="not-found"): ...


class MethodNotAllowed(SpecshieldError, type="method-not-allowed"): ...


class SessionDamaged(SpecshieldError, type="session-damaged"): ...


class Conflict(SpecshieldError, type="conflict"): ...


class HistoryGap(Conflict, type="history-gap"): ...


class HistoryConflict(Conflict, type="history-conflict"): ...


class StepConflict(Conflict, type="step-conflict"): ...


class SessionFinished(Conflict, type="session-finished"): ...


class SessionExists(Conflict, type="session-exists"): ...


class NameTaken(Conflict, type="name-taken"): ...


class InUse(Conflict, type="in-use"): ...


class Unauthorized(SpecshieldError, type="unauthorized"): ...


class CrossSite(SpecshieldError, type="cross-site"): ...


class MisdirectedRequest(SpecshieldError, type="misdirected-request"): ...


class LimitReached(SpecshieldError, type="limit-reached"): ...


class RateLimited(LimitReached, type="rate-limited"): ...


class InsufficientStorage(SpecshieldError, type="insufficient-storage"): ...


class Busy(SpecshieldError, type="busy"): ...


class RequestTimeout(SpecshieldError, type="request-timeout"): ...


class TrainingUnavailable(SpecshieldError, type="training-unavailable"): ...


class Starting(SpecshieldError, type="starting"): ...


class Stopping(SpecshieldError, type="stopping"): ...


class StoreError(SpecshieldError, type="store-unavailable"): ...


class ServerError(SpecshieldError, type="internal-error"): ...


class TransportError(SpecshieldError, type="transport-error"): ...


class TransportTimeout(TransportError, type="transport-timeout"): ...


def tree(root: type[SpecshieldError] = SpecshieldError) -> Iterator[type[SpecshieldError]]:
    """`root` and everything below it, parents first."""
    yield root
    for child in root.__subclasses__():
        yield from tree(child)
