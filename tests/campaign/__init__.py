"""A campaign of generated lies: input that is well formed and false, told to the command that would meet it.

    python -m tests.campaign COUNT SEED [--only N]

prints, as JSON, how many lies of each family end in each verdict, the slowest, the largest, and the failures with
their numbers; with `--only N` the lie of that number alone, with all that was said. `tests.campaign.joined` joins
campaigns of several seeds.

| verdict  | meaning                                                                                                |
|----------|--------------------------------------------------------------------------------------------------------|
| refused  | exit status 2 and one line on standard error                                                           |
| said     | a finding of `check` above a note, a fault of the recording, or a number declared missing or not valid |
| harmless | no word, and the numbers that come out equal those of the honest input (`TOLERANCE`)                    |
| SILENT   | no word, and the numbers differ: a failure                                                             |
| BROKEN   | a traceback, a warning of NumPy, more than one line, over 10 s or 1 GiB: a failure                     |

No reader can tell a lie that is another honest measurement. The generators leave these out by construction:

- a gain, an offset or a delay within the scatter of honest devices: force and pressure within a factor of ten of the
  truth, EIT within a factor of ten, delays below 0.5 s, places that move by less than half a pad;
- two errors that undo each other: two lies at once are of different kinds;
- numbers that a file states and nothing else in it repeats: the span of a pressure sensor, the unit of a column
  without header, the scale of a clock without a stated rate, the rate of a table without a clock, the gain of a
  calibration within a factor of ten;
- wishes: a scene asks for a simulation, and whatever can be simulated is simulated as it is written.
"""
