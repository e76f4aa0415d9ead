"""Regrasps: a finger that moves alone, while the object rests on its other contacts.

Four constraints that fix the object and the other finger leave a path along which only one joint moves. Contacts that
slide along such a path have no slip, so that their friction counts for nothing; those that roll, that is stick, have
forces of their own within the friction cone. The forces are then determined, and their margin is one that friction can
give: statics (`margin.statics`) may allow more.
"""

from collections.abc import Sequence

from wholearm_jax.model.scene import AWAY, AWAY_NAMES, LINKS, parse_contact

CONSTRAINTS = 4  # of a path: the configuration has five coordinates
_CLOSING_SIGN = {1: "+", 2: "-"}  # the sign in which each joint angle closes its finger on the object
_OPENING_SIGN = {1: "-", 2: "+"}


def regrasp_finger(regrasp: str) -> int:
    """Return the number of the finger that a regrasp moves: 1 for `finger1:v2` or `finger1:away`.

    Raises:
        ValueError: for what is no sliding contact of a finger, and not `away`.
    """
    link, _, _, rolls = parse_contact(regrasp)
    if link == 0 or rolls:
        raise ValueError(f"'{regrasp}': a regrasp moves a finger: write finger1:v2, finger1:e3 or finger1:away")
    return link


def regrasp_toward(regrasp: str) -> str:
    """Return the way in which the finger turns: it closes to make a contact, and opens to be away."""
    finger = regrasp_finger(regrasp)
    sign = (_OPENING_SIGN if parse_contact(regrasp)[1] == AWAY else _CLOSING_SIGN)[finger]
    return f"theta{finger}{sign}"


def hold_contacts(contacts: Sequence[str], regrasp: str) -> tuple[str, ...]:
    """Return the constraints that hold the object while a finger moves.

    Args:
        contacts: the contacts that hold the object. If none of them is said to roll, as many stick as four constraints
            need, those on the palm first; the other finger is away unless it has a contact.
        regrasp: the contact that the finger makes, or `finger1:away`.

    Raises:
        ValueError: where the moving finger is among the contacts, or the constraints are not four.
    """
    finger, rows = regrasp_finger(regrasp), [parse_contact(text) for text in contacts]
    links, other = [row[0] for row in rows], 3 - regrasp_finger(regrasp)
    if finger in links:
        raise ValueError(f"{LINKS[finger]} moves; name the contacts that hold the object without it")
    contacts = [*contacts] if other in links else [*contacts, AWAY_NAMES[other - 1]]
    free = CONSTRAINTS - len(contacts)
    if not any(row[3] for row in rows):
        touching = [text for text in contacts if parse_contact(text)[1] != AWAY]
        sticking = sorted(touching, key=lambda text: parse_contact(text)[0] != 0)[: max(free, 0)]
        contacts = [f"{text} rolling" if text in sticking else text for text in contacts]
    count = len(contacts) + sum(parse_contact(text)[3] for text in contacts)
    if count != CONSTRAINTS:
        raise ValueError(f"{count} constraints; a hold needs exactly {CONSTRAINTS}, two a contact that sticks")
    return tuple(contacts)
