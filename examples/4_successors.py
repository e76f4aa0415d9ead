"""List the contact formations that can follow a phase, with their margins at rest and their upper bounds."""

import wholearm_jax as wa
from wholearm_jax.planning import successor_formations, touching_contacts

wa.configure()
scene = wa.load("heptagon")
first, _ = wa.trace(scene)
print("contacts at the end of the first phase:", ", ".join(touching_contacts(scene, first.end)))
for successor in successor_formations(scene, first.end):
    if successor.bound > 0:
        print(
            f"{' '.join(successor.contacts):44}  toward {successor.toward:7}"
            f"  at rest {successor.static:6.3f} N  bound {successor.bound:6.3f} N"
        )
