"""Navigation of the tip past obstacles: a collision-free path in joint space, time-optimal within the stages' limits."""

from host.navigation.request import PlanAnswer, PlanRequest, plan

__all__ = ["PlanAnswer", "PlanRequest", "plan"]
