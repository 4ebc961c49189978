"""What cannot be exported."""


class ExportError(ValueError):
    """A calibration that cannot be exported as asked; the message says what to do.

    Example:
        try:
            calib.export_c(mine, "skin.h", prefix="1skin")
        except calib.export.ExportError as error:
            print(error)
    """
