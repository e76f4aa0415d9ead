"""What became of a phase or a plan: one name each, never a NaN without one."""

import enum


class Status(enum.IntEnum):
    """Outcome of a trace, a simulated phase or a whole plan.

    The numeric values travel through compiled programs and batches; `label` is what the files print. The page
    `docs/statuses.md` has them all.

    >>> wa.Status.STUCK.label, wa.Status.STUCK.advice.partition(";")[0]
    ('stuck', 'friction holds the object at rest')
    """

    OK = 0
    CONTACT_LOST = 1
    STUCK = 2
    REVERSED = 3
    NOT_REACHED = 4
    LEFT_FORMATION = 5
    AMBIGUOUS = 6
    SINGULAR = 7
    NO_CONVERGENCE = 8
    MAX_STEPS = 9
    OBSTACLE = 10
    TOO_SHORT = 11

    @property
    def label(self) -> str:
        """The name that summary files and messages use, e.g. `contact_lost`."""
        return self.name.lower()

    @property
    def advice(self) -> str:
        """What the status means and what to try, in one sentence."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "every contact stays in compression and the object arrives as planned",
    Status.CONTACT_LOST: "a contact force turns tensile; squeeze harder, move more slowly, or optimise",
    Status.STUCK: "friction holds the object at rest; raise the torque that pushes it, or lower the squeeze",
    Status.REVERSED: "the object moves backward along its path; raise the torque that pushes it",
    Status.NOT_REACHED: "time ran out before the object arrived; give the phase more time or more torque",
    Status.LEFT_FORMATION: "the path ends while the object moves, or the start is outside the formation; brake earlier",
    Status.AMBIGUOUS: "friction allows both directions at once (Painleve); lower the friction or the squeeze",
    Status.SINGULAR: "rank is lost (wedging, fold, branch), or `toward` names a still coordinate; change the phase",
    Status.NO_CONVERGENCE: "Newton's method or the table did not converge; check the start, or refine the table",
    Status.OBSTACLE: "links meet or a joint's range ends: end the phase before with `until`, or change the hand",
    Status.TOO_SHORT: "no torque within limits moves the object in so little time; give the phase more time",
    Status.MAX_STEPS: "the step limit was reached; raise it, or shorten the phase",
}
