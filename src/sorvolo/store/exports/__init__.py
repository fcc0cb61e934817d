"""Files written for other programs, and for people who open them: one file for each kind."""
