/* A reading u of three axes to specific force a, in g, under a calibration with second-order nonlinearity (q2) and
   temperature bias (qT): k, m, b are its scale factors, misalignments and biases, dT the temperature less
   channel_reference. No allocation, no library. */
void apply(const double k[3], const double m[3], const double b[3], const double q2[3], const double qT[3],
           double dT, const double u[3], double a[3]) {
    double s[3];
    for (int i = 0; i < 3; i++) {
        double v = u[i] / k[i] - b[i] - qT[i] * dT;
        s[i] = v;
        for (int n = 0; n < 10; n++) s[i] = v - q2[i] * s[i] * s[i];
    }
    a[2] = s[2];                              /* R is upper triangular: m is (x, y, z) */
    a[1] = s[1] - m[0] * a[2];
    a[0] = s[0] - m[2] * a[1] - m[1] * a[2];
}
