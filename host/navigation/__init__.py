"""Navigation of the tip past obstacles: a collision-free path in joint space, time-optimal within the stages' limits."""

from host.navigation.request import Answer, PlanRequest, plan

__all__ = ["Answer", "PlanRequest", "plan"]
