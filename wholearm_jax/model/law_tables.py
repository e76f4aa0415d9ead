"""A closed-loop law as arrays: what a motion along a path needs of a controller, differentiable in every number."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class PhaseTables(eqx.Module):
    """The law of one phase, linear between rows; or of all phases, with a leading axis.

    `s` [rad] is the length of the curve of joint angles; rows that only fill up repeat the last.
    """

    # along the path
    s: Float[Array, "*phases nodes"]
    theta: Float[Array, "*phases nodes 2"]  # [rad]
    tangent: Float[Array, "*phases nodes 2"]
    gain: Float[Array, "*phases nodes 2"]  # [N m s^2]
    length: Float[Array, "*phases"]  # [rad]

    # over the time since the phase began
    time: Float[Array, "*phases times"]  # [s]
    s_ref: Float[Array, "*phases times"]  # [rad]
    v_ref: Float[Array, "*phases times"]  # [rad/s]
    torque: Float[Array, "*phases times 2"]  # feed-forward [N m]

    # the end
    flows: Bool[Array, "*phases"]  # whether the next phase goes on without a stop
    reach: Float[Array, "*phases"]  # [rad]
    approach: Float[Array, "*phases"]  # [rad/s]
    press: Float[Array, "*phases"]  # [rad/s^2]


class LawTables(eqx.Module):
    """A closed-loop law for a plan (`docs/feedback.md`), in continuous time: without sampling and delay."""

    phases: PhaseTables  # with a leading axis
    stiffness: Float[Array, ""]  # w [1/s]
    integral: Float[Array, ""]  # k [1/s]
    observer: Float[Array, ""]  # w_o [1/s]
    push: Float[Array, ""]  # [N m]
    settle: Float[Array, ""]  # time for which an object must stand before a phase ends at a stop [s]
    patience: Float[Array, ""]  # [s]
    torque_limit: Float[Array, "2"]  # [N m]

    @property
    def count(self) -> int:
        """Number of phases."""
        return self.phases.s.shape[0]
