"""Figures over the sheet of a skin: electrodes, designs, the contact layer, and results in space."""
