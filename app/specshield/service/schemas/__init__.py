"""What the HTTP contract takes and gives."""

from specshield.service.schemas.sessions import SessionRequest
from specshield.service.schemas.steps import CloseRequest, StepRequest

__all__ = ["CloseRequest", "SessionRequest", "StepRequest"]
