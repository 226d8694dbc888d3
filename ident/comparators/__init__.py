"""What identification is compared with: ARX, ARMAX, OE and N4SID fits, and free runs of any linear model."""
