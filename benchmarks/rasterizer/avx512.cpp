// The seeded scenes of benchmarks/rasterizer/scenes.py as a renderer written by hand for AVX-512 draws them: a measure for
// the numba kernels of msdgs_serve/rasterizer, whose semantics it has. Colour only, a pinhole camera, harmonics of
// degree 3, usable numbers. All scratch is kept from frame to frame.
//
// The Gaussians' arrays are those of msdgs_serve.scene.Gaussians; lanes are Gaussians while projecting and while
// testing ellipses, and the 4 x 4 pixels of a block while blending.
#include <immintrin.h>
#include <sys/mman.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <barrier>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <span>
#include <thread>
#include <vector>

namespace {

using Vec = __m512;
constexpr int kLanes = 16, kTile = 16, kBatch = 64, kChunk = 2048, kDigitBits = 11, kBuckets = 1 << kDigitBits;
constexpr int kHarmonics = 48, kTilesATurn = 4, kAhead = 16;
constexpr float kReachScale = 1.3862944f;  // 2 ln 2: of a distance in log2 of alpha to one in standard deviations

// Columns of a record, one cache line a splat.
enum { kX, kY, kRootA, kRootB, kRootC, kLog2Opacity, kRed, kGreen, kBlue, kPerRootA, kExtremeY, kUsed, kRecord = 16 };

Vec all(float value) { return _mm512_set1_ps(value); }
Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a, b, c); }
Vec clamp(Vec a, Vec low, Vec high) { return _mm512_max_ps(_mm512_min_ps(a, high), low); }
Vec polynomial(Vec x, std::span<const float> coefficients) {
    Vec value = all(coefficients[0]);
    for (float coefficient : coefficients.subspan(1)) value = fma(value, x, all(coefficient));
    return value;
}

// 2 atanh(s) / ln 2 over s in s², for log2 of a mantissa.
constexpr float kAtanh[] = {0.32059890f, 0.41219859f, 0.57707802f, 0.96179669f, 2.88539008f};
// 2^(x / 8) on [-8, 0]: its eighth power is 2^x. Interpolated at Chebyshev's nodes in x / 8 + 1/2.
constexpr float kEighthRoot[] = {2.889639371e-08f, 2.248335048e-06f, 1.080041400e-04f,
                                 3.752796192e-03f, 8.664289183e-02f, 9.999999439e-01f};

Vec log2_of(Vec x) {
    Vec exponent = _mm512_getexp_ps(x), mantissa = _mm512_getmant_ps(x, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_zero);
    __mmask16 upper = _mm512_cmp_ps_mask(mantissa, all(1.41421356f), _CMP_GT_OQ);
    mantissa = _mm512_mask_mul_ps(mantissa, upper, mantissa, all(0.5f));
    exponent = _mm512_mask_add_ps(exponent, upper, exponent, all(1));
    Vec s = (mantissa - all(1)) / (mantissa + all(1));
    return fma(s, polynomial(s * s, kAtanh), exponent);
}

// Columns 4k to 4k + 3 of 16 rows.
template <typename Row>
void load_four_columns(Row row, Vec* columns) {
    Vec v[4];
    for (int r = 0; r < 4; r++) {
        v[r] = _mm512_castps128_ps512(_mm_loadu_ps(row(r)));
        v[r] = _mm512_insertf32x4(v[r], _mm_loadu_ps(row(4 + r)), 1);
        v[r] = _mm512_insertf32x4(v[r], _mm_loadu_ps(row(8 + r)), 2);
        v[r] = _mm512_insertf32x4(v[r], _mm_loadu_ps(row(12 + r)), 3);
    }
    Vec a = _mm512_unpacklo_ps(v[0], v[1]), b = _mm512_unpackhi_ps(v[0], v[1]);
    Vec c = _mm512_unpacklo_ps(v[2], v[3]), d = _mm512_unpackhi_ps(v[2], v[3]);
    columns[0] = _mm512_castpd_ps(_mm512_unpacklo_pd(_mm512_castps_pd(a), _mm512_castps_pd(c)));
    columns[1] = _mm512_castpd_ps(_mm512_unpackhi_pd(_mm512_castps_pd(a), _mm512_castps_pd(c)));
    columns[2] = _mm512_castpd_ps(_mm512_unpacklo_pd(_mm512_castps_pd(b), _mm512_castps_pd(d)));
    columns[3] = _mm512_castpd_ps(_mm512_unpackhi_pd(_mm512_castps_pd(b), _mm512_castps_pd(d)));
}

// 16 triples, 48 numbers in a row, as three columns.
void load_triples(const float* source, Vec* columns) {
    Vec a = _mm512_loadu_ps(source), b = _mm512_loadu_ps(source + 16), c = _mm512_loadu_ps(source + 32);
    for (int column = 0; column < 3; column++) {
        alignas(64) int first[16], second[16];
        for (int k = 0; k < 16; k++) {
            int place = 3 * k + column;
            first[k] = place < 32 ? place : 0;
            second[k] = place < 32 ? k : 16 + place - 32;
        }
        Vec two = _mm512_permutex2var_ps(a, _mm512_load_si512(first), b);
        columns[column] = _mm512_permutex2var_ps(two, _mm512_load_si512(second), c);
    }
}

// 16 columns as 16 rows in memory, one after the other, 64-byte aligned.
void store_rows(const Vec* columns, float* target) {
    Vec w[4][4];
    for (int j = 0; j < 4; j++) {
        const Vec* v = columns + 4 * j;
        Vec a = _mm512_unpacklo_ps(v[0], v[1]), b = _mm512_unpackhi_ps(v[0], v[1]);
        Vec c = _mm512_unpacklo_ps(v[2], v[3]), d = _mm512_unpackhi_ps(v[2], v[3]);
        w[j][0] = _mm512_castpd_ps(_mm512_unpacklo_pd(_mm512_castps_pd(a), _mm512_castps_pd(c)));
        w[j][1] = _mm512_castpd_ps(_mm512_unpackhi_pd(_mm512_castps_pd(a), _mm512_castps_pd(c)));
        w[j][2] = _mm512_castpd_ps(_mm512_unpacklo_pd(_mm512_castps_pd(b), _mm512_castps_pd(d)));
        w[j][3] = _mm512_castpd_ps(_mm512_unpackhi_pd(_mm512_castps_pd(b), _mm512_castps_pd(d)));
    }
    for (int r = 0; r < 4; r++) {
        Vec low01 = _mm512_shuffle_f32x4(w[0][r], w[1][r], 0x44), high01 = _mm512_shuffle_f32x4(w[0][r], w[1][r], 0xee);
        Vec low23 = _mm512_shuffle_f32x4(w[2][r], w[3][r], 0x44), high23 = _mm512_shuffle_f32x4(w[2][r], w[3][r], 0xee);
        _mm512_store_ps(target + kRecord * r, _mm512_shuffle_f32x4(low01, low23, 0x88));
        _mm512_store_ps(target + kRecord * (4 + r), _mm512_shuffle_f32x4(low01, low23, 0xdd));
        _mm512_store_ps(target + kRecord * (8 + r), _mm512_shuffle_f32x4(high01, high23, 0x88));
        _mm512_store_ps(target + kRecord * (12 + r), _mm512_shuffle_f32x4(high01, high23, 0xdd));
    }
}

// An array on huge pages that grows and is never given back before the end.
template <typename T>
class Scratch {
public:
    ~Scratch() { std::free(data_); }
    T* sized(size_t count) {
        if (count > count_) {
            constexpr size_t page = 1 << 21;
            size_t bytes = (count * sizeof(T) + page - 1) / page * page;
            std::free(data_);
            data_ = static_cast<T*>(std::aligned_alloc(page, bytes));
            madvise(data_, bytes, MADV_HUGEPAGE);
            count_ = bytes / sizeof(T);
        }
        return data_;
    }
    T* get() const { return data_; }

private:
    T* data_ = nullptr;
    size_t count_ = 0;
};

}  // namespace

extern "C" {

struct Scene {
    int64_t count;
    const float *means, *quats, *scales, *opacities, *harmonics;
};

struct View {
    float rotation[9], translation[3], position[3];
    float fx, fy, cx, cy, min_x, max_x, min_y, max_y;
    float near_plane, eps2d, alpha_min, alpha_max, transmittance_min, background[3];
    int32_t width, height;
};

}  // extern "C"

namespace {

struct Rectangle {
    uint16_t left, right, top, bottom;  // tiles, each first and past the last
};

using Clock = std::chrono::steady_clock;
constexpr int kStages = 4;

struct Part {
    std::vector<int32_t> digits, corners, cursors;
    uint32_t least, largest;
    std::array<Clock::time_point, kStages> ends;
};

class Renderer {
public:
    explicit Renderer(int threads) : threads_(threads), barrier_(threads), parts_(threads) {}

    void draw(const Scene& scene, const View& view, float* rgb, double* seconds) {
        auto start = Clock::now();  // of a stage, which ends when its last thread does
        prepare(scene, view, rgb);
        std::vector<std::jthread> others;
        for (int t = 1; t < threads_; t++) others.emplace_back([this, t] { run(t); });
        run(0);
        for (int stage = 0; stage < kStages; stage++) {
            auto end = start;
            for (const Part& part : parts_) end = std::max(end, part.ends[stage]);
            seconds[stage] = std::chrono::duration<double>(end - start).count();
            start = end;
        }
    }

private:
    int threads_;
    std::barrier<> barrier_;
    std::vector<Part> parts_;
    Scene scene_{};
    View view_{};
    float* rgb_ = nullptr;
    int columns_ = 0, rows_ = 0, chunks_ = 0;
    int64_t visible_ = 0;
    std::atomic<int> next_chunk_{0}, next_tile_{0};
    Scratch<float> records_;
    Scratch<Rectangle> rectangles_, ordered_;
    Scratch<uint64_t> keys_, other_keys_;
    Scratch<uint32_t> ids_;
    std::vector<int32_t> found_, offsets_;

    void prepare(const Scene& scene, const View& view, float* rgb) {
        scene_ = scene, view_ = view, rgb_ = rgb, visible_ = 0;
        columns_ = (view.width + kTile - 1) / kTile, rows_ = (view.height + kTile - 1) / kTile;
        chunks_ = static_cast<int>((scene.count + kChunk - 1) / kChunk);
        size_t padded = static_cast<size_t>(chunks_) * kChunk;
        records_.sized(padded * kRecord), rectangles_.sized(padded), ordered_.sized(padded);
        keys_.sized(padded), other_keys_.sized(padded);
        found_.assign(chunks_, 0), offsets_.assign(columns_ * rows_ + 1, 0);
        next_chunk_ = 0, next_tile_ = 0;
        for (Part& part : parts_) {
            part.digits.assign(kBuckets, 0), part.corners.assign((columns_ + 1) * (rows_ + 1), 0);
            part.cursors.assign(columns_ * rows_, 0), part.least = UINT32_MAX, part.largest = 0;
        }
    }

    void run(int thread) {
        for (int chunk; (chunk = next_chunk_++) < chunks_;) project(chunk, parts_[thread]);
        finish(thread, 0);
        sort(thread);
        finish(thread, 1);
        bin(thread);
        finish(thread, 2);
        int tiles = columns_ * rows_;
        for (int first; (first = next_tile_.fetch_add(kTilesATurn)) < tiles;)
            for (int tile = first; tile < std::min(first + kTilesATurn, tiles); tile++) composite(tile);
        finish(thread, 3);
    }

    void finish(int thread, int stage) {
        parts_[thread].ends[stage] = Clock::now();
        barrier_.arrive_and_wait();
    }

    // Part `thread` of a number of things.
    std::pair<int64_t, int64_t> share(int64_t count, int thread) const {
        return {count * thread / threads_, count * (thread + 1) / threads_};
    }

    void project(int chunk, Part& part);
    void project_sixteen(const float* means, const float* quats, const float* scales, const float* opacities,
                         const float* harmonics, int64_t first, int many, int chunk, Part& part);
    void sort(int thread);
    void bin(int thread);
    void composite(int tile);
    void test_ellipses(const uint32_t* ids, int many, float x0, float y0, struct Batch& batch) const;
    void write_block(int x, int y, Vec red, Vec green, Vec blue) const;
};

void Renderer::project(int chunk, Part& part) {
    int64_t start = static_cast<int64_t>(chunk) * kChunk, stop = std::min<int64_t>(start + kChunk, scene_.count);
    for (int64_t i = start; i < stop; i += kLanes) {
        int many = static_cast<int>(std::min<int64_t>(kLanes, stop - i));
        const Scene& s = scene_;
        if (many == kLanes) {
            project_sixteen(s.means + 3 * i, s.quats + 4 * i, s.scales + 3 * i, s.opacities + i,
                            s.harmonics + kHarmonics * i, i, many, chunk, part);
        } else {
            float means[3 * kLanes]{}, quats[4 * kLanes]{}, scales[3 * kLanes]{}, opacities[kLanes]{};
            float harmonics[kHarmonics * kLanes]{};
            std::copy_n(s.means + 3 * i, 3 * many, means), std::copy_n(s.quats + 4 * i, 4 * many, quats);
            std::copy_n(s.scales + 3 * i, 3 * many, scales), std::copy_n(s.opacities + i, many, opacities);
            std::copy_n(s.harmonics + kHarmonics * i, kHarmonics * many, harmonics);
            project_sixteen(means, quats, scales, opacities, harmonics, i, many, chunk, part);
        }
    }
}

void Renderer::project_sixteen(const float* means, const float* quats, const float* scales, const float* opacities,
                               const float* harmonics, int64_t first, int many, int chunk, Part& part) {
    const View& v = view_;
    const float* r = v.rotation;
    Vec m[3], q[4], size[3];
    load_triples(means, m);
    auto turned = [&](Vec x, Vec y, Vec z, int row) {
        return fma(all(r[3 * row]), x, fma(all(r[3 * row + 1]), y, all(r[3 * row + 2]) * z));
    };
    Vec x = turned(m[0], m[1], m[2], 0) + all(v.translation[0]);
    Vec y = turned(m[0], m[1], m[2], 1) + all(v.translation[1]);
    Vec z = turned(m[0], m[1], m[2], 2) + all(v.translation[2]);
    Vec opacity = _mm512_loadu_ps(opacities);
    __mmask16 drawn = _mm512_cmp_ps_mask(z, all(v.near_plane), _CMP_GT_OQ) & static_cast<__mmask16>((1u << many) - 1);
    drawn = _mm512_mask_cmp_ps_mask(drawn, opacity, all(v.alpha_min), _CMP_GE_OQ);
    if (!drawn) return;
    load_four_columns([&](int k) { return quats + 4 * k; }, q);
    load_triples(scales, size);

    Vec per_z = all(1) / z, ratio_x = x * per_z, ratio_y = y * per_z;
    Vec u = fma(all(v.fx), ratio_x, all(v.cx)), w = fma(all(v.fy), ratio_y, all(v.cy));
    Vec jxx = all(v.fx) * per_z, jyy = all(v.fy) * per_z;
    Vec jxz = -jxx * clamp(ratio_x, all(v.min_x), all(v.max_x));
    Vec jyz = -jyy * clamp(ratio_y, all(v.min_y), all(v.max_y));
    Vec qw = q[0], qx = q[1], qy = q[2], qz = q[3], two = all(2), one = all(1);
    Vec axes[3][3] = {
        {one - two * (qy * qy + qz * qz), two * (qx * qy + qw * qz), two * (qx * qz - qw * qy)},
        {two * (qx * qy - qw * qz), one - two * (qx * qx + qz * qz), two * (qy * qz + qw * qx)},
        {two * (qx * qz + qw * qy), two * (qy * qz - qw * qx), one - two * (qx * qx + qy * qy)},
    };
    Vec hx[3], hy[3];
    for (int k = 0; k < 3; k++) {
        Vec depth = turned(axes[k][0], axes[k][1], axes[k][2], 2);
        hx[k] = fma(jxx, turned(axes[k][0], axes[k][1], axes[k][2], 0), jxz * depth) * size[k];
        hy[k] = fma(jyy, turned(axes[k][0], axes[k][1], axes[k][2], 1), jyz * depth) * size[k];
    }
    // the determinant as a sum of squares (Cauchy-Binet): nothing cancels in float32
    Vec eps = all(v.eps2d);
    Vec xx = hx[0] * hx[0] + hx[1] * hx[1] + hx[2] * hx[2], yy = hy[0] * hy[0] + hy[1] * hy[1] + hy[2] * hy[2];
    Vec xy = hx[0] * hy[0] + hx[1] * hy[1] + hx[2] * hy[2];
    Vec d0 = hx[1] * hy[2] - hx[2] * hy[1], d1 = hx[2] * hy[0] - hx[0] * hy[2], d2 = hx[0] * hy[1] - hx[1] * hy[0];
    Vec det = d0 * d0 + d1 * d1 + d2 * d2 + eps * (xx + yy) + eps * eps;
    xx += eps, yy += eps;

    Vec log2_opacity = log2_of(_mm512_max_ps(opacity, all(v.alpha_min)));
    Vec reach = (log2_opacity - all(std::log2(v.alpha_min))) * all(kReachScale);
    Vec extent_x = fma(_mm512_sqrt_ps(reach * xx), all(1.0001f), all(1e-3f));
    Vec extent_y = fma(_mm512_sqrt_ps(reach * yy), all(1.0001f), all(1e-3f));
    // from the first to the last pixel centre that is within reach
    Vec left = u - extent_x - all(0.5f), right = u + extent_x - all(0.5f);
    Vec top = w - extent_y - all(0.5f), bottom = w + extent_y - all(0.5f);
    drawn = _mm512_mask_cmp_ps_mask(drawn, right, all(0), _CMP_GE_OQ);
    drawn = _mm512_mask_cmp_ps_mask(drawn, bottom, all(0), _CMP_GE_OQ);
    drawn = _mm512_mask_cmp_ps_mask(drawn, left, all(static_cast<float>(v.width - 1)), _CMP_LE_OQ);
    drawn = _mm512_mask_cmp_ps_mask(drawn, top, all(static_cast<float>(v.height - 1)), _CMP_LE_OQ);
    if (!drawn) return;
    auto tile_of = [](Vec pixel, float offset, int most) {
        Vec place = fma(pixel, all(1.0f / kTile), all(offset));
        return _mm512_cvttps_epi32(clamp(place, all(0), all(static_cast<float>(most))));
    };
    auto ceil_of = [](Vec pixel) { return _mm512_roundscale_ps(pixel, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC); };
    __m512i columns = _mm512_or_si512(tile_of(ceil_of(left), 0, columns_),
                                      _mm512_slli_epi32(tile_of(right, 1, columns_), 16));
    __m512i rows = _mm512_or_si512(tile_of(ceil_of(top), 0, rows_), _mm512_slli_epi32(tile_of(bottom, 1, rows_), 16));

    Vec dx = m[0] - all(v.position[0]), dy = m[1] - all(v.position[1]), dz = m[2] - all(v.position[2]);
    Vec per_distance = all(1) / _mm512_sqrt_ps(dx * dx + dy * dy + dz * dz);
    dx *= per_distance, dy *= per_distance, dz *= per_distance;
    Vec dxx = dx * dx, dyy = dy * dy, dzz = dz * dz;
    Vec basis[16] = {
        all(0.28209479f), all(-0.48860251f) * dy, all(0.48860251f) * dz, all(-0.48860251f) * dx,
        all(1.09254843f) * dx * dy, all(-1.09254843f) * dy * dz, all(0.31539157f) * (two * dzz - dxx - dyy),
        all(-1.09254843f) * dx * dz, all(0.54627422f) * (dxx - dyy),
        all(-0.59004359f) * dy * (all(3) * dxx - dyy), all(2.89061144f) * dx * dy * dz,
        all(-0.45704580f) * dy * (all(4) * dzz - dxx - dyy),
        all(0.37317633f) * dz * (two * dzz - all(3) * dxx - all(3) * dyy),
        all(-0.45704580f) * dx * (all(4) * dzz - dxx - dyy), all(1.44530572f) * dz * (dxx - dyy),
        all(-0.59004359f) * dx * (dxx - all(3) * dyy),
    };
    Vec colors[3] = {all(0.5f), all(0.5f), all(0.5f)};
#pragma GCC unroll 12
    for (int group = 0; group < kHarmonics / 4; group++) {
        Vec four[4];
        load_four_columns([&](int k) { return harmonics + kHarmonics * k + 4 * group; }, four);
#pragma GCC unroll 4
        for (int k = 0; k < 4; k++) {
            int place = 4 * group + k;
            colors[place % 3] = fma(basis[place / 3], four[k], colors[place % 3]);
        }
    }
    Vec root_a = _mm512_sqrt_ps(yy / det) * all(0.84932180f), record[kRecord];
    std::fill_n(record, kRecord, all(0));
    record[kX] = u, record[kY] = w, record[kRootA] = root_a, record[kRootB] = -xy / yy * root_a;
    record[kRootC] = all(0.84932180f) / _mm512_sqrt_ps(yy), record[kLog2Opacity] = log2_opacity;
    for (int c = 0; c < 3; c++) record[kRed + c] = _mm512_max_ps(colors[c], all(0));
    record[kPerRootA] = all(1) / root_a, record[kExtremeY] = extent_x * xy / xx;
    store_rows(record, records_.get() + kRecord * first);

    auto* rectangles = reinterpret_cast<uint32_t*>(rectangles_.get() + first);
    __m512i low = _mm512_permutex2var_epi32(
        columns, _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23), rows);
    __m512i high = _mm512_permutex2var_epi32(
        columns, _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31), rows);
    _mm512_storeu_si512(rectangles, low), _mm512_storeu_si512(rectangles + 16, high);

    __m512i bits = _mm512_castps_si512(z);
    part.least = std::min(part.least, _mm512_mask_reduce_min_epu32(drawn, bits));
    part.largest = std::max(part.largest, _mm512_mask_reduce_max_epu32(drawn, bits));
    alignas(64) uint32_t depths[kLanes];
    _mm512_store_si512(depths, bits);
    uint64_t* keys = keys_.get() + static_cast<int64_t>(chunk) * kChunk;
    for (uint32_t left_over = drawn; left_over; left_over &= left_over - 1) {
        int lane = std::countr_zero(left_over);
        keys[found_[chunk]++] = static_cast<uint64_t>(depths[lane]) << 32 | static_cast<uint32_t>(first + lane);
    }
}

// By 22 bits between the nearest and the farthest depth, in two passes; the first closes the chunks' gaps.
void Renderer::sort(int thread) {
    uint32_t least = UINT32_MAX, largest = 0;
    for (const Part& part : parts_) least = std::min(least, part.least), largest = std::max(largest, part.largest);
    if (least > largest) return;
    int shift = std::max(0, static_cast<int>(std::bit_width(largest - least)) - 2 * kDigitBits);
    if (thread == 0) visible_ = std::accumulate(found_.begin(), found_.end(), int64_t{0});
    auto [chunk, past_chunk] = share(chunks_, thread);
    std::vector<int32_t>& digits = parts_[thread].digits;
    auto digit_of = [&](uint64_t key, int pass) {
        return ((static_cast<uint32_t>(key >> 32) - least) >> (shift + kDigitBits * pass)) & (kBuckets - 1);
    };
    auto cursors_of = [&] {
        std::array<int32_t, kBuckets> cursors;
        int32_t total = 0;
        for (int bucket = 0; bucket < kBuckets; bucket++)
            for (int t = 0; t < threads_; t++) {
                if (t == thread) cursors[bucket] = total;
                total += parts_[t].digits[bucket];
            }
        return cursors;
    };
    const uint64_t *keys = keys_.get(), *others = other_keys_.get();
    for (int64_t c = chunk; c < past_chunk; c++)
        for (int64_t k = c * kChunk; k < c * kChunk + found_[c]; k++) digits[digit_of(keys[k], 0)]++;
    barrier_.arrive_and_wait();
    auto cursors = cursors_of();
    for (int64_t c = chunk; c < past_chunk; c++)
        for (int64_t k = c * kChunk; k < c * kChunk + found_[c]; k++)
            other_keys_.get()[cursors[digit_of(keys[k], 0)]++] = keys[k];
    barrier_.arrive_and_wait();
    std::fill(digits.begin(), digits.end(), 0);
    auto [first, past] = share(visible_, thread);
    for (int64_t k = first; k < past; k++) digits[digit_of(others[k], 1)]++;
    barrier_.arrive_and_wait();
    cursors = cursors_of();
    for (int64_t k = first; k < past; k++) keys_.get()[cursors[digit_of(others[k], 1)]++] = others[k];
}

void Renderer::bin(int thread) {
    auto [first, past] = share(visible_, thread);
    const uint64_t* keys = keys_.get();
    const Rectangle* rectangles = rectangles_.get();
    Rectangle* ordered = ordered_.get();
    Part& part = parts_[thread];
    int stride = columns_ + 1;
    for (int64_t k = first; k < past; k++) {
        if (k + kAhead < past) _mm_prefetch(rectangles + static_cast<uint32_t>(keys[k + kAhead]), _MM_HINT_T0);
        Rectangle r = ordered[k] = rectangles[static_cast<uint32_t>(keys[k])];
        part.corners[r.top * stride + r.left]++, part.corners[r.top * stride + r.right]--;
        part.corners[r.bottom * stride + r.left]--, part.corners[r.bottom * stride + r.right]++;
    }
    for (int row = 0; row <= rows_; row++)
        for (int column = 0; column <= columns_; column++) {
            int32_t& here = part.corners[row * stride + column];
            if (column) here += (&here)[-1];
            if (row) here += (&here)[-stride];
            if (row && column) here -= (&here)[-stride - 1];
        }
    barrier_.arrive_and_wait();
    if (thread == 0) {
        int32_t total = 0;
        for (int tile = 0; tile < columns_ * rows_; tile++) {
            offsets_[tile] = total;
            for (Part& some : parts_) {
                some.cursors[tile] = total;
                total += some.corners[tile / columns_ * stride + tile % columns_];
            }
        }
        offsets_[columns_ * rows_] = total;
        ids_.sized(static_cast<size_t>(total) + kLanes);
    }
    barrier_.arrive_and_wait();
    uint32_t* ids = ids_.get();
    for (int64_t k = first; k < past; k++) {
        Rectangle r = ordered[k];
        uint32_t id = static_cast<uint32_t>(keys[k]);
        for (int row = r.top; row < r.bottom; row++)
            for (int tile = row * columns_ + r.left; tile < row * columns_ + r.right; tile++)
                ids[part.cursors[tile]++] = id;
    }
}

// Up to 64 splats: log2 of alpha is LogOpacity - p² - q² with p = A x + B y + P, q = C y + Q, x and y from the tile's
// corner; the splats that reach a block are bits of its mask.
struct Batch {
    alignas(64) float a[kBatch], b[kBatch], p[kBatch], c[kBatch], q[kBatch], log2_opacity[kBatch];
    alignas(64) float red[kBatch], green[kBatch], blue[kBatch];
    alignas(64) uint16_t masks[kTile][kBatch / kLanes];
};

// Lanes are splats. In a row of blocks, from its first to its last row of pixel centres, an ellipse reaches furthest
// right where that row is nearest to its extreme point, and the same to the left.
void Renderer::test_ellipses(const uint32_t* ids, int many, float x0, float y0, Batch& batch) const {
    const float* records = records_.get();
    float least = std::log2(view_.alpha_min);
    for (int group = 0; group < kBatch / kLanes; group++) {
        int start = group * kLanes;
        if (start >= many) {
            for (auto& mask : batch.masks) mask[group] = 0;
            continue;
        }
        const float* rows[kLanes];
        for (int k = 0; k < kLanes; k++)
            rows[k] = records + static_cast<size_t>(kRecord) * ids[std::min(start + k, many - 1)];
        Vec s[12];
        for (int j = 0; j < 3; j++) load_four_columns([&](int k) { return rows[k] + 4 * j; }, s + 4 * j);
        Vec x = s[kX] - all(x0), y = s[kY] - all(y0), a = s[kRootA], b = s[kRootB], c = s[kRootC];
        _mm512_store_ps(batch.a + start, a), _mm512_store_ps(batch.b + start, b);
        _mm512_store_ps(batch.c + start, c), _mm512_store_ps(batch.log2_opacity + start, s[kLog2Opacity]);
        _mm512_store_ps(batch.p + start, -fma(a, x, b * y)), _mm512_store_ps(batch.q + start, -c * y);
        _mm512_store_ps(batch.red + start, s[kRed]), _mm512_store_ps(batch.green + start, s[kGreen]);
        _mm512_store_ps(batch.blue + start, s[kBlue]);
        Vec reach = fma(s[kLog2Opacity] - all(least), all(1.001f), all(1e-3f)), per_a = s[kPerRootA];
        __mmask16 there = static_cast<__mmask16>((1u << std::min(many - start, kLanes)) - 1);
        for (int row = 0; row < 4; row++) {
            Vec low = all(4 * row + 0.5f) - y, high = low + all(3);
            Vec at_right = clamp(s[kExtremeY], low, high), at_left = clamp(-s[kExtremeY], low, high);
            auto half = [&](Vec at) { return _mm512_fnmadd_ps(c * at, c * at, reach); };
            Vec right = half(at_right), left = half(at_left);
            __mmask16 meets = _mm512_mask_cmp_ps_mask(there, right, all(0), _CMP_GE_OQ);
            auto root = [](Vec square) {
                square = _mm512_max_ps(square, all(1e-20f));
                return square * _mm512_rsqrt14_ps(square);
            };
            right = fma(_mm512_fnmadd_ps(b, at_right, root(right)), per_a, x);
            left = fma(_mm512_fnmadd_ps(b, at_left, -root(left)), per_a, x);
            for (int column = 0; column < 4; column++) {
                __mmask16 hit = _mm512_mask_cmp_ps_mask(meets, right, all(4 * column + 0.5f), _CMP_GE_OQ);
                hit = _mm512_mask_cmp_ps_mask(hit, left, all(4 * column + 3.5f), _CMP_LE_OQ);
                batch.masks[4 * row + column][group] = hit;
            }
        }
    }
}

struct Block {
    Vec light, red, green, blue;
    __mmask16 open;  // pixels to which splats may still add
};

void blend(const Batch& batch, uint64_t splats, Vec x, Vec y, const View& view, float log2_alpha_min, Block& block) {
    Vec light = block.light, red = block.red, green = block.green, blue = block.blue;
    __mmask16 open = block.open;
    const Vec least = all(log2_alpha_min), most = all(view.alpha_max), dark = all(view.transmittance_min);
    for (; splats; splats &= splats - 1) {
        size_t k = std::countr_zero(splats);
        Vec p = fma(all(batch.a[k]), x, fma(all(batch.b[k]), y, all(batch.p[k])));
        Vec q = fma(all(batch.c[k]), y, all(batch.q[k]));
        Vec exponent = _mm512_fnmadd_ps(p, p, _mm512_fnmadd_ps(q, q, all(batch.log2_opacity[k])));
        __mmask16 seen = _mm512_cmp_ps_mask(exponent, least, _CMP_GE_OQ);
        Vec power = polynomial(exponent, kEighthRoot);
        power *= power, power *= power, power *= power;
        Vec weight = _mm512_maskz_min_ps(seen, power, most) * light;
        Vec after = light - weight;
        open = _mm512_mask_cmp_ps_mask(open, after, dark, _CMP_GT_OQ);
        light = _mm512_mask_mov_ps(light, open, after);
        red = _mm512_mask3_fmadd_ps(all(batch.red[k]), weight, red, open);
        green = _mm512_mask3_fmadd_ps(all(batch.green[k]), weight, green, open);
        blue = _mm512_mask3_fmadd_ps(all(batch.blue[k]), weight, blue, open);
    }
    block = {light, red, green, blue, open};
}

void Renderer::composite(int tile) {
    alignas(64) Batch batch;
    Block blocks[kTile];
    std::fill_n(blocks, kTile, Block{all(1), all(0), all(0), all(0), 0xffff});
    int x0 = kTile * (tile % columns_), y0 = kTile * (tile / columns_);
    const Vec in_block_x = _mm512_setr_ps(.5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5, .5, 1.5, 2.5, 3.5);
    const Vec in_block_y = _mm512_setr_ps(.5, .5, .5, .5, 1.5, 1.5, 1.5, 1.5, 2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 3.5, 3.5);
    float log2_alpha_min = std::log2(view_.alpha_min);
    uint32_t open = 0xffff;
    const uint32_t* ids = ids_.get();
    int last = offsets_[columns_ * rows_] - 1;
    for (int begin = offsets_[tile]; begin < offsets_[tile + 1] && open; begin += kBatch) {
        int many = std::min(kBatch, offsets_[tile + 1] - begin);
        for (int k = begin + many; k < begin + many + kBatch; k++)
            _mm_prefetch(records_.get() + static_cast<size_t>(kRecord) * ids[std::min(k, last)], _MM_HINT_T0);
        test_ellipses(ids + begin, many, static_cast<float>(x0), static_cast<float>(y0), batch);
        for (uint32_t left = open; left; left &= left - 1) {
            int k = std::countr_zero(left);
            uint64_t splats;
            std::memcpy(&splats, batch.masks[k], sizeof splats);
            if (!splats) continue;
            Vec x = in_block_x + all(static_cast<float>(4 * (k % 4))), y = in_block_y + all(static_cast<float>(k / 4 * 4));
            blend(batch, splats, x, y, view_, log2_alpha_min, blocks[k]);
            if (!blocks[k].open) open &= ~(1u << k);
        }
    }
    for (int k = 0; k < kTile; k++) {
        const float* behind = view_.background;
        Block& b = blocks[k];
        write_block(x0 + 4 * (k % 4), y0 + k / 4 * 4, fma(b.light, all(behind[0]), b.red),
                    fma(b.light, all(behind[1]), b.green), fma(b.light, all(behind[2]), b.blue));
    }
}

void Renderer::write_block(int x, int y, Vec red, Vec green, Vec blue) const {
    int across = std::clamp(view_.width - x, 0, 4);
    if (!across) return;
    __mmask16 columns = static_cast<__mmask16>((1u << (3 * across)) - 1);
    for (int row = 0; row < std::min(4, view_.height - y); row++) {
        int p = 4 * row;
        __m512i two = _mm512_setr_epi32(p, 16 + p, 0, p + 1, 17 + p, 0, p + 2, 18 + p, 0, p + 3, 19 + p, 0, 0, 0, 0, 0);
        __m512i three = _mm512_setr_epi32(0, 1, 16 + p, 3, 4, 17 + p, 6, 7, 18 + p, 9, 10, 19 + p, 0, 0, 0, 0);
        Vec line = _mm512_permutex2var_ps(_mm512_permutex2var_ps(red, two, green), three, blue);
        _mm512_mask_storeu_ps(rgb_ + 3 * (static_cast<size_t>(y + row) * view_.width + x), columns, line);
    }
}

}  // namespace

extern "C" {

void* new_renderer(int threads) { return new Renderer(threads); }

void delete_renderer(void* renderer) { delete static_cast<Renderer*>(renderer); }

// Fills rgb [height, width, 3], and the seconds of projecting, sorting, binning and compositing.
void draw(void* renderer, const Scene* scene, const View* view, float* rgb, double* seconds) {
    static_cast<Renderer*>(renderer)->draw(*scene, *view, rgb, seconds);
}
}
