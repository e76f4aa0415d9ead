"""How far a contact opens at which the impact of a new formation would have to pull.

Derivation: section 5 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from wholearm_jax.dynamics import Impact, PathDynamics
from wholearm_jax.margin import force_slack

IMPULSE_ROUNDING = 1e-9  # fraction of `Impact.size` by which rounding may make an impulse negative
MAX_OPENING = 1e-6  # [m], less than surfaces are rough: a contact that opens no farther counts as kept


class ContactOpening(NamedTuple):
    """The opening of a contact after an impact that would have to pull at it."""

    height: Float[Array, ""]  # how far it opens [m]; 0 where no impulse pulls, infinite where it does not close again
    duration: Float[Array, ""]  # for how long [s]
    contact: Int[Array, ""]  # its row, where the impulse is least


def contact_opening(dynamics: PathDynamics, impact: Impact, force: Float[Array, "rows"]) -> ContactOpening:
    """Compute how far a contact opens if it does not pull in an impact.

    With `p_j < 0` left out its gap opens at the speed `u = -p_j / N_jj`, `N` the contact-space inertia, and the others
    push by `p_i + N_ij u`. The force `c_j` that would hold it shut closes it again at `c_j / N_jj`: after
    `-2 p_j / c_j` it has been open by at most `p_j^2 / (2 c_j N_jj)`. A second impact, with impulses `N_ij u`, shuts
    it, and lets those open in turn for which these are negative. Whatever the contacts do, their wrenches do not act
    along the path: the object goes on as if they had pushed and pulled.

    Args:
        dynamics: Path dynamics of the formation that is entered.
        impact: Its impact, as if contacts could pull.
        force: Constraint forces just after it [N], likewise.

    Returns:
        The opening, the farther one where others open in turn. Its height is infinite where several contacts would be
        pulled at in the first impact, another one would slip that rolls, or no force closes one that opens.
    """
    dynamics, impact, force = stop_gradient((dynamics, impact, force))  # it decides a status alone
    slack = force_slack(dynamics, impact.impulse)  # impulses have the cones of forces
    pulls = slack < -IMPULSE_ROUNDING * impact.size
    j = jnp.argmin(slack)
    speed = -impact.impulse[j] / dynamics.contact_inertia[j, j]
    second = dynamics.contact_inertia[:, j] * speed  # impulses of the impact that shuts it
    first = (impact.impulse + second).at[j].set(0.0)
    # Who opens, and how far; contacts that roll must neither open nor slip.
    opens = ((second < 0) & ~dynamics.tangential).at[j].set(True)
    inertia = jnp.diagonal(dynamics.contact_inertia)
    closes = ~opens | ((force > 0) & (inertia > 0))
    rolls = dynamics.tangential | jnp.roll(dynamics.tangential, -1)
    sticks = ~rolls | ((force_slack(dynamics, second) >= 0) & ~opens)
    pushes = force_slack(dynamics, first) >= 0
    known = (pulls.sum() == 1) & (speed > 0) & (closes & sticks & pushes).all()
    height = jnp.where(known, jnp.where(opens, second**2 / (2 * force * inertia), 0.0).max(), jnp.inf)
    duration = jnp.where(known, -2 * impact.impulse[j] / force[j], jnp.inf)
    any_pulls = pulls.any()
    return ContactOpening(jnp.where(any_pulls, height, 0.0), jnp.where(any_pulls, duration, 0.0), j)
