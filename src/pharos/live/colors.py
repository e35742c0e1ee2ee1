"""Okabe and Ito's colours, which those can tell apart, too, who see no red or green."""
BLUE, VERMILION, GREEN = '#0072B2', '#D55E00', '#009E73'
PURPLE, SKY, ORANGE = '#CC79A7', '#56B4E9', '#E69F00'
