"""Everything that this package changes in LeRobot or hooks into; `seams` lists what and why."""
