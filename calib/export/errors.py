"""What cannot be exported."""


class ExportError(ValueError):
    """A calibration that cannot be exported as asked; the message says what to do."""
