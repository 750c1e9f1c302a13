"""Every change of a pose by optimisation: PnP, the mask's outline, the outline in the picture's colours."""
