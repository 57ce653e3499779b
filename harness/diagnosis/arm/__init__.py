"""The closed loop of an arm, judged by inverse dynamics: what the whole arm lacks, then what every joint lacks."""
