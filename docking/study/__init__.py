"""Studies, `docking study NAME`: many dockings, fits, recordings or pictures with drawn errors, and what is counted.

One module a study; `pose` is a room of its own. Nothing else imports them but the command line.
"""
