"""Where contacts are: estimators of their places, images of presses, and loads over time."""
