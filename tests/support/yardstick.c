/* Two kernels whose speed is published for many processors: heap sort, and Gauss elimination by columns.
 * Prints the arrays of 8,111 integers sorted in a second of processor time, then millions of floating-point
 * operations a second, of a system of 200 equations with Linpack's count of operations. The best of five. */
#include <math.h>
#include <stdio.h>
#include <time.h>

enum { EQUATIONS = 200, INTEGERS = 8111, ROUNDS = 5 };
#define ROUND_S 0.2

static double matrix[EQUATIONS][EQUATIONS + 1], right[EQUATIONS];
static int array[INTEGERS];
static unsigned state = 1;

static double processor_time(void) {
    struct timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static unsigned drawn(void) { return (state = state * 1664525u + 1013904223u) >> 8; }

static void sift(int at, int count) {
    int value = array[at], child;
    while ((child = 2 * at + 1) < count) {
        if (child + 1 < count && array[child + 1] > array[child]) child++;
        if (array[child] <= value) break;
        array[at] = array[child];
        at = child;
    }
    array[at] = value;
}

static void sort(void) {
    for (int i = INTEGERS / 2 - 1; i >= 0; i--) sift(i, INTEGERS);
    for (int count = INTEGERS - 1; count > 0; count--) {
        int top = array[0];
        array[0] = array[count];
        array[count] = top;
        sift(0, count);
    }
}

static void solve(void) {
    for (int k = 0; k < EQUATIONS; k++) {
        int pivot = k;
        for (int i = k + 1; i < EQUATIONS; i++)
            if (fabs(matrix[k][i]) > fabs(matrix[k][pivot])) pivot = i;
        double scale = matrix[k][pivot];
        matrix[k][pivot] = matrix[k][k];
        matrix[k][k] = scale;
        for (int i = k + 1; i < EQUATIONS; i++) matrix[k][i] *= -1.0 / scale;
        for (int j = k + 1; j <= EQUATIONS; j++) {
            double *column = j < EQUATIONS ? matrix[j] : right;
            double factor = column[pivot];
            column[pivot] = column[k];
            column[k] = factor;
            for (int i = k + 1; i < EQUATIONS; i++) column[i] += factor * matrix[k][i];
        }
    }
    for (int k = EQUATIONS - 1; k >= 0; k--) {
        right[k] /= matrix[k][k];
        for (int i = 0; i < k; i++) right[i] -= right[k] * matrix[k][i];
    }
}

int main(void) {
    double sorts = 0.0, flops = 0.0, n = EQUATIONS, sum = 0.0;
    for (int round = 0; round < ROUNDS; round++) {
        int count = 0, solved = 0;
        double spent = 0.0, begun;
        for (; spent < ROUND_S; count++) {
            for (int i = 0; i < INTEGERS; i++) array[i] = (int)drawn();
            begun = processor_time();
            sort();
            spent += processor_time() - begun;
        }
        if (count / spent > sorts) sorts = count / spent;
        for (spent = 0.0; spent < ROUND_S; solved++) {
            for (int k = 0; k < EQUATIONS; k++) {
                right[k] = 1.0;
                for (int i = 0; i < EQUATIONS; i++) matrix[k][i] = drawn() / 16777216.0 - 0.5;
            }
            begun = processor_time();
            solve();
            spent += processor_time() - begun;
            sum += right[0];
        }
        double rate = 1e-6 * solved * (2.0 / 3.0 * n * n * n + 2.0 * n * n) / spent;
        if (rate > flops) flops = rate;
    }
    printf("%.6g %.6g %g\n", sorts, flops, sum);
    return 0;
}
