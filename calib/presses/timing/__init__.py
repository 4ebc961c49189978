"""When presses are: detection, times, windows, and delays of the streams."""
