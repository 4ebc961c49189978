"""Which readings should a skin take? A hundred of all that its electrodes allow, in place of the shipped 550."""

import jax
import numpy as np

import jaxeit as je

jax.config.update("jax_enable_x64", True)  # jaxeit never changes the settings of JAX for you

skin = je.load_skin("testbed")
model = je.discretise(je.Scene(skin), je.Fidelity.draft())

# What every reading tells of contacts of 12 mm at 25 places; 8 columns and all candidates take some ten seconds more.
sensitivity = je.scan.place_sensitivity(model, je.scan.DesignSettings(columns=5))
candidates = je.skin.all_pairs(len(skin.electrodes))
design = je.scan.design_scan(sensitivity, 100, candidates=candidates[::4])

better = je.skin.with_rows(skin, design.pattern)  # better.toml is the text of its file
errors = {
    f"{name}, {some.protocol.readings}": 1e3 * float(sensitivity.errors(some.protocol.pattern).mean())
    for name, some in (("shipped", skin), ("designed", better))
}
for name, error in errors.items():
    print(f"{name} readings: expected error of a contact's place {error:.2f} mm, mean over the sheet")
print(f"no 100 of these {len(candidates[::4])} readings can be better than {1e3 * design.bound:.2f} mm")

pairs = skin.electrode_positions[design.pattern[:, :2]]
print(f"driven electrodes are {1e3 * np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1).mean():.0f} mm apart on average")
