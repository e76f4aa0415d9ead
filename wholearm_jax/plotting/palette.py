"""Colours and dashes of figures and reports: Okabe and Ito's, distinct with any colour vision."""

LINK_COLOURS = ("#0072B2", "#D55E00")
"""Finger 1 and finger 2 on a white background."""

DARK_LINK_COLOURS = ("#56B4E9", "#F58A4B")
"""The same on a black background."""

CONTACT_COLOURS = ("#000000", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#8B6914", "#0072B2", "#D55E00")
"""Contacts in the order in which a plan names them, on a white background."""

DARK_CONTACT_COLOURS = ("#F2F2F2", "#E69F00", "#00C08B", "#E08FC0", "#7CC7F2", "#C9A23E", "#3A9BDC", "#F58A4B")
"""The same on a black background."""

DASHES = ((), (4.0, 1.6), (6.0, 1.8, 1.2, 1.8), (1.2, 1.4))
"""Strokes and gaps in line widths; the dashes change after every fourth contact."""


def contact_styles(formations) -> dict[str, tuple[int, int]]:
    """Return contact name -> (index of its colour, index of its dashes), in the order in which formations name them."""
    names = dict.fromkeys(name for contacts in formations for name in contacts)
    return {name: (k % len(CONTACT_COLOURS), k // 4 % len(DASHES)) for k, name in enumerate(names)}
